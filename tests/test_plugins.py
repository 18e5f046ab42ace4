"""Plug-ins: a class in a file is known by its name as soon as the file is loaded; what is wrong with it is told."""

from __future__ import annotations

import importlib.metadata
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spadmnist import config, document, identity, plugins
from spadmnist.effects import STAGES, Effect
from spadmnist.errors import EffectError, InputError
from spadmnist.events import Layout
from spadmnist.inference.candidates import candidates, first_strengths
from spadmnist.inference.coordinates import is_edge
from spadmnist.inference.trial import frequencies_of
from spadmnist.plugins import ByWavelength, Distribution, MapFile, Parameter
from spadmnist.reconstruct import Method
from spadmnist.sensor import Sensor

HEAD = "from spadmnist import Effect, parameter\n\n\n"
HALF = (
    HEAD
    + '''class HalfLight(Effect, stage="light"):
    """Half of the light is lost on the way."""

    share = parameter(0.5, "", "share that passes", bounds=(0, 1), off=1.0, per_pixel=True)

    def apply(self, rate, conditions):
        return rate * self.share

    expected_rate = apply
'''
)


@pytest.fixture(autouse=True)
def forgotten() -> Iterator[None]:
    """What a test loads is gone after it."""
    plugins.discover()
    effects, methods = dict(Effect.registry.classes), dict(Method.registry.classes)
    loaded, packages, modules = dict(plugins._loaded), dict(plugins._packages), set(sys.modules)
    yield
    Effect.registry.classes.clear()
    Effect.registry.classes.update(effects)
    Method.registry.classes.clear()
    Method.registry.classes.update(methods)
    plugins._loaded.clear()
    plugins._loaded.update(loaded)
    plugins._packages.clear()
    plugins._packages.update(packages)
    for name in set(sys.modules) - modules:
        if name.startswith(("spadmnist_plugin_", "optics")):
            del sys.modules[name]


def written(folder: Path, text: str, name: str = "mine.py") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def refused(path: Path) -> str:
    """The one line with which a plug-in file is refused; nothing of it stays."""
    before = dict(Effect.registry.classes)
    modules = set(sys.modules)
    with pytest.raises(EffectError) as caught:
        plugins.load_file(path)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message
    assert Effect.registry.classes == before
    assert path.resolve() not in plugins.loaded_files()
    assert not [m for m in set(sys.modules) - modules if m.startswith("spadmnist_plugin_")]
    return message


# --- what the package brings ---------------------------------------------------------------------------------------


def test_every_file_of_the_folder_is_an_effect() -> None:
    folder = Path(plugins.__file__).parent / "effects"
    files = {p.stem for p in folder.glob("[!_]*.py")}
    assert files == {n for n in Effect.registry if Effect.registry.find(n).__module__.startswith("spadmnist.")}
    assert len(files) >= 5


@pytest.mark.parametrize("name", list(Effect.registry))
def test_every_effect_says_what_it_is(name: str) -> None:
    cls: Any = Effect.registry.find(name)
    assert cls.name == name and cls.stage in STAGES
    assert len(cls.summary()) > 20 and "Source:" in cls.__doc__
    for key, declared in cls.parameters.items():
        assert declared.name == key and declared.about
        for value in (declared.default, declared.off, *(declared.search or ())):
            if value is not None and not isinstance(value, bool) and not declared.choices:
                declared.check(value)


@pytest.mark.parametrize("name", list(Method.registry))
def test_every_method_says_what_it_is(name: str) -> None:
    cls: Any = Method.registry.find(name)
    assert cls.name == name and "Source:" in cls.__doc__ and cls.columns and cls.unit in ("1/s", "1")
    assert set(cls.readouts()) <= {"tr", "str", "qis"}


def test_the_registry_is_in_order_and_suggests() -> None:
    assert list(Effect.registry) == sorted(Effect.registry)
    with pytest.raises(
        KeyError, match=r"dead_tme is not an effect\. Did you mean dead_time\? \(spadmnist effects lists all\)"
    ):
        Effect.registry.find("dead_tme")
    with pytest.raises(KeyError, match=r"count is not a method\. Did you mean counts\?"):
        Method.registry.find("count")
    with pytest.raises(KeyError) as unlike:
        Effect.registry.find("qqqq")
    assert str(unlike.value) == (
        "qqqq is not an effect. (spadmnist effects lists all; --plugin FILE.py loads one of your own)"
    )


# --- files ---------------------------------------------------------------------------------------------------------


def test_a_class_in_a_file_is_an_effect(tmp_path: Path) -> None:
    path = written(tmp_path, HALF)
    plugins.load_file(path)
    assert "half_light" in list(Effect.registry)
    cls: Any = Effect.registry.find("half_light")
    assert plugins.source_file(cls) == str(path) and cls.summary() == "Half of the light is lost on the way."
    assert cls.parameters["share"] == Parameter(
        0.5, "", "share that passes", bounds=(0, 1), off=1.0, per="pixel", kind="smooth", name="share"
    )
    assert cls().share == 0.5 and cls(share=0.25).apply(np.array([4.0]), None) == [1.0]
    with pytest.raises(TypeError, match=r"half_light has no parameter shar\. Did you mean share\?"):
        cls(shar=1)
    assert plugins.loaded_files()[path] == HALF


def test_a_file_is_run_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, HALF + "\nopen(__file__ + '.ran', 'a').write('x')\n")
    plugins.load_file(path)
    monkeypatch.chdir(tmp_path)
    plugins.load_file("mine.py")
    plugins.load_file(tmp_path / "." / "mine.py")
    assert (tmp_path / "mine.py.ran").read_text() == "x"


def test_a_file_may_hold_several(tmp_path: Path) -> None:
    more = HALF.replace("HalfLight", "Shade2D").removeprefix(HEAD)
    plugins.load_file(written(tmp_path, HALF + "\n\n" + more))
    assert {"half_light", "shade2_d"} <= set(Effect.registry) or {"half_light", "shade2d"} <= set(Effect.registry)


def test_two_files_of_one_name_are_two_files(tmp_path: Path) -> None:
    for folder, name in (("a", "HalfLight"), ("b", "ThirdLight")):
        (tmp_path / folder).mkdir()
        plugins.load_file(written(tmp_path / folder, HALF.replace("HalfLight", name)))
    assert {"half_light", "third_light"} <= set(Effect.registry)


def test_the_same_name_in_two_files_is_refused_with_both(tmp_path: Path) -> None:
    first = written(tmp_path, HALF, "first.py")
    plugins.load_file(first)
    message = refused(written(tmp_path, HALF + "# another\n", "second.py"))
    assert str(first) in message and "half_light" in message and "another name" in message


def test_a_copy_of_a_file_is_another_file(tmp_path: Path) -> None:
    """The same text in two places: which of them is meant is not for us to say."""
    first = written(tmp_path, HALF, "first.py")
    plugins.load_file(first)
    assert str(first) in refused(written(tmp_path, HALF, "second.py"))


@pytest.mark.parametrize("name", ["DeadTime", "Detection"])
def test_a_name_of_ours_is_refused(name: str, tmp_path: Path) -> None:
    message = refused(written(tmp_path, HALF.replace("HalfLight", name)))
    assert "already there" in message and "effects" in message


def test_what_a_file_defined_before_it_failed_is_forgotten(tmp_path: Path) -> None:
    path = written(tmp_path, HALF + "\n1 / 0\n")
    assert "half_light" not in refused(path)
    path.write_text(HALF)
    plugins.load_file(path)
    assert "half_light" in set(Effect.registry)


PULSE = (
    HEAD
    + """class Pulse(Effect, stage="arrival"):
    depth = parameter(0.1, "", "depth", bounds=(0, 1), off=0.0, search=(0.01, 1))
    PASS

    def factor(self, times, conditions):
        return 1 + 0 * times

    def maximum(self, conditions):
        return 1.0
"""
)
# what every effect has, and no parameter can be called
TAKEN = (
    *("name", "last", "cause", "counted", "hazard", "mimic", "by_pixel", "shown", "summary", "after", "stage"),
    *("registry", "parameters", "made", "influence", "expected_rate", "moves", "acts_on", "on_light"),
)
LINES = [
    ("syntax", HEAD + "class A(Effect, stage='light'\n    pass\n", 4, "SyntaxError"),
    ("indentation", HEAD + "class A(Effect, stage='light'):\npass\n", 5, "IndentationError"),
    ("raises", HEAD + "x = 1\nraise ValueError('no good')\n", 5, "ValueError: no good"),
    ("division", HEAD + "def f():\n    return 1 / 0\n\n\nf()\n", 5, "ZeroDivisionError"),
    ("import", "import spadmnist\nimport no_such_module_at_all\n", 2, "no_such_module_at_all"),
    ("exits", "import sys\nsys.exit(3)\n", 2, "SystemExit"),
    ("stage", HALF.replace('"light"', '"lihgt"'), 4, "'lihgt'"),
    ("no stage", HALF.replace(', stage="light"', ""), 4, "stage"),
    ("hook", HEAD + "class A(Effect, stage='light'):\n    pass\n", 4, "apply"),
    ("two hooks", HEAD + "class A(Effect, stage='arrival'):\n    pass\n", 4, "factor and maximum"),
    ("no function", HEAD + "class A(Effect, stage='gate'):\n    open = 5\n", 4, "open"),
    ("unit", HALF.replace('0.5, ""', '0.5, "furlong"'), 7, "furlong"),
    ("multiple", HALF.replace('0.5, ""', '0.5, "MHz"'), 7, "write 'Hz', and all numbers in it"),
    ("acts on", PULSE.replace("PASS", "acts_on = 'drak'"), 4, "acts_on is 'drak'; it is one of light, dark, own. Did"),
    ("needs", PULSE.replace("PASS", "a = parameter(1.0, '', 'x', needs='deph')"), 4, "Did you mean depth?"),
    ("__init__", PULSE.replace("PASS", "__init__ = print"), 4, "belongs into made(self, chip)"),
    ("own __init__", PULSE.replace("PASS", "def __init__(self): pass"), 4, "does not take the values"),
    ("first of __init__", PULSE.replace("PASS", "def __init__(self, x, **more): pass"), 4, "leave it out"),
    *((name, PULSE.replace("depth", name).replace("PASS", ""), 4, f"cannot be called {name}, which") for name in TAKEN),
]  # fmt: skip


@pytest.mark.parametrize(("text", "line", "says"), [x[1:] for x in LINES], ids=[x[0] for x in LINES])
def test_a_file_that_fails_is_told_with_its_line(text: str, line: int, says: str, tmp_path: Path) -> None:
    path = written(tmp_path, text)
    message = refused(path)
    assert message.startswith(f"{path}:{line}: ") and says in message


def test_all_stages_are_told_where_one_is_unknown(tmp_path: Path) -> None:
    message = refused(written(tmp_path, HALF.replace('stage="light"', 'stage="lite"')))
    assert all(stage in message for stage in STAGES)


def test_an_interrupt_is_no_mistake_of_the_file(tmp_path: Path) -> None:
    """Ctrl-C while a plug-in is loaded ends the program; it is not the plug-in that is wrong."""
    with pytest.raises(KeyboardInterrupt):
        plugins.load_file(written(tmp_path, "raise KeyboardInterrupt\n"))


@pytest.mark.parametrize("name", ["missing.py", "folder", "words.txt", "binary.py"])
def test_a_file_that_is_none(name: str, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "words.txt").write_text("x = 1\n")
    (tmp_path / "binary.py").write_bytes(b"\xff\xfe\x00x")
    refused(tmp_path / name)


# --- parameters ----------------------------------------------------------------------------------------------------


def read(declared: Parameter, raw: Any, base: Path = Path()) -> Any:
    found: list[tuple[tuple[Any, ...], str]] = []
    value = plugins.read_value(declared, raw, base, lambda path, sentence: found.append((path, sentence)))
    return found if found else value


BOUNDED = Parameter(1e-9, "s", "", bounds=(0, 1e-6), name="width", per="pixel")
OPEN = Parameter(1e-9, "s", "", bounds=(0, None), open_bounds=True, name="width")
CAPPED = Parameter(0.0, "", "", bounds=(None, 3.0), name="width")


@pytest.mark.parametrize(
    ("declared", "raw", "value"),
    [
        (BOUNDED, "0 s", 0.0),
        (BOUNDED, "1 us", 1e-6),
        (OPEN, "1 ps", 1e-12),
        (CAPPED, 3, 3.0),
        (CAPPED, -1e9, -1e9),
        (Parameter(False, "bool", "", name="on"), True, True),
        (BOUNDED, {"file": "a.npy"}, MapFile(Path("a.npy").resolve())),
        (BOUNDED, {"normal": {"mean": "5 ns", "sigma": "1 ns"}}, Distribution("normal", (5e-9, 1e-9))),
        (BOUNDED, {"lognormal": {"median": "5 ns", "sigma": 2}}, Distribution("lognormal", (5e-9, 2.0))),
        (Parameter(0.5, "", "", by_wavelength=True, name="pdp"), {"700 nm": 0.1, "500 nm": "40 %"},
         ByWavelength((500e-9, 700e-9), (0.4, 0.1))),
    ],
)  # fmt: skip
def test_a_value_is_read(declared: Parameter, raw: Any, value: Any) -> None:
    assert read(declared, raw) == value


@pytest.mark.parametrize(
    ("declared", "raw", "says"),
    [
        (BOUNDED, "-1 ns", "width is between 0 s and 1 us"),
        (BOUNDED, "2 us", "width is between 0 s and 1 us"),
        (OPEN, "0 s", "width is more than 0 s"),
        (CAPPED, 3.5, "width is at most 3"),
        (CAPPED, {"500 nm": 1}, "forms"),
        (OPEN, {"file": "a.npy"}, "one number"),
        (OPEN, {"normal": {"mean": "1 s", "sigma": "1 s"}}, "one number"),
        (Parameter(False, "bool", "", name="on"), "yes", "true or false"),
        (Parameter(False, "bool", "", name="on"), 1, "true or false"),
    ],
)
def test_a_value_out_of_bounds_is_told_what_is_allowed(declared: Parameter, raw: Any, says: str) -> None:
    ((_, sentence),) = read(declared, raw)
    assert says in sentence


WORD = Parameter("nearest", "", "", choices=("nearest", "floor"), name="rounding")


@pytest.mark.parametrize("word", ["nearest", "floor"])
def test_a_word_is_read(word: str) -> None:
    assert read(WORD, word) == word and WORD.allowed() == "nearest or floor"


@pytest.mark.parametrize("raw", ["Nearest", "ceil", "", 0, True, None, ["floor"], {"file": "a.npy"}])
def test_a_word_that_is_none_of_the_choices(raw: Any) -> None:
    (((), sentence),) = read(WORD, raw)
    assert sentence == f"{raw!r} is not possible; rounding is nearest or floor"


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"choices": ("a", "b")}, "'c' is none of the choices a, b"),
        ({"per": "frame"}, "'frame' is none of '', 'pixel', 'row', 'column', 'code'"),
        ({"search": 0.5}, r"about: search is 0\.5; it is two numbers, \(least, most\)"),
        ({"search": (0.5, None)}, r"search is \(0\.5, None\); it is two numbers"),
        ({"search": ("a", "b")}, "it is two numbers"),
        ({"search": (0.5, 0.1)}, "the least number comes first"),
        ({"bounds": (1, 0)}, r"bounds is \(1, 0\); the least number comes first"),
        ({"bounds": 1}, "bounds is 1; it is two numbers"),
    ],
)
def test_a_parameter_that_cannot_be_declared(values: dict[str, Any], says: str) -> None:
    with pytest.raises(TypeError, match=says):
        plugins.parameter("c" if "choices" in values else 1.0, "", "about", **values)


# --- maps: one value for each pixel, row, column or code -------------------------------------------------------------

# per -> (shapes that a map may have, shapes that fit, shapes that do not) on 4 rows of 6 columns, with 5 codes
SHAPES: dict[str, tuple[Any, Any, Any]] = {
    "pixel": (((4, 6), (24,)), [(4, 6), (24,)], [(6, 4), (23,), (4, 6, 1), (2, 12), (), (0,)]),
    "row": (((4,),), [(4,)], [(6,), (5,), (4, 6), (4, 1), (24,), ()]),
    "column": (((6,),), [(6,)], [(4,), (7,), (4, 6), (1, 6), (24,), ()]),
    "code": (((5,), (-1,), (24, -1)), [(5,), (9,), (1,), (24, 5), (24, 1)], [(0,), (24, 0), (4, 6, 5), (23, 5), ()]),
}
ALL = [(per, i, shape) for per, (_, *kinds) in SHAPES.items() for i, kind in enumerate(kinds) for shape in kind]


@pytest.mark.parametrize(("per", "wrong", "shape"), ALL)
def test_a_map_fits_what_it_is_per(per: str, wrong: int, shape: tuple[int, ...], tmp_path: Path) -> None:
    gain = Parameter(1.0, "", "", bounds=(0, None), name="gain", per=per)
    values = np.arange(1.0, np.prod(shape) + 1).reshape(shape)
    np.save(tmp_path / "gain.npy", values)
    found = read(gain, {"file": "gain.npy"}, tmp_path)
    shapes = SHAPES[per][0]
    if not wrong:
        resolved = plugins.resolve(gain, found, shapes, "k")
        assert np.array_equal(resolved, values.ravel() if per == "pixel" else values) and resolved.dtype == np.float64
        return
    with pytest.raises(InputError) as caught:
        plugins.resolve(gain, found, shapes, "k")
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'gain.npy'}: is float64 of shape {shape}, but gain needs one number for")
    wanted = message.partition("one number for ")[2]
    assert wanted.startswith(f"each {per}: {shapes[0]}") and "-" not in wanted


@pytest.mark.parametrize("per", SHAPES)
def test_a_map_with_a_value_that_cannot_be(per: str, tmp_path: Path) -> None:
    gain = Parameter(1.0, "", "", bounds=(0, 2), name="gain", per=per)
    shape = SHAPES[per][0][0]
    for value, says in ((-0.5, "-0.5 is not possible; gain is between 0 and 2"), (np.nan, f"every {per} needs")):
        values = np.ones(int(np.prod(shape)))
        values[3] = value
        np.save(tmp_path / "gain.npy", values.reshape(shape))
        with pytest.raises(InputError, match=f"entry 3 of the map.*{says}"):
            plugins.resolve(gain, MapFile(tmp_path / "gain.npy"), SHAPES[per][0], "k")


@pytest.mark.parametrize("per", SHAPES)
def test_a_distribution_has_a_value_for_each(per: str) -> None:
    gain = Parameter(1.0, "", "", name="gain", per=per)
    found = read(gain, {"normal": {"mean": 1, "sigma": 0.1}})
    drawn = plugins.resolve(gain, found, SHAPES[per][0], "k")
    assert drawn.shape == (int(np.prod(SHAPES[per][0][0])),) and len(np.unique(drawn)) == drawn.size


def test_what_is_one_number_takes_no_map() -> None:
    gain = Parameter(1.0, "", "", name="gain")
    for raw in ({"file": "a.npy"}, {"normal": {"mean": 1, "sigma": 1}}):
        ((_, sentence),) = read(gain, raw)
        assert "one number for the whole array" in sentence


def test_a_table_ends_at_its_ends() -> None:
    table = ByWavelength((500e-9, 700e-9), (0.4, 0.2))
    assert table.at(500e-9) == 0.4 and table.at(700e-9) == 0.2 and table.at(600e-9) == pytest.approx(0.3)
    for outside in (499e-9, 701e-9):
        with pytest.raises(InputError, match="500 nm to 700 nm"):
            table.at(outside)


def test_a_distribution_is_drawn_by_its_law() -> None:
    """Means and spreads of 100,000 draws, 5 standard errors wide (false-alarm rate 1e-6)."""
    n = 100_000
    normal = plugins.resolve(BOUNDED, Distribution("normal", (5e-7, 1e-8)), ((1, n),), "k")
    assert abs(normal.mean() - 5e-7) < 5 * 1e-8 / np.sqrt(n) and abs(normal.std() / 1e-8 - 1) < 5 / np.sqrt(2 * n)
    wide = Parameter(1.0, "Hz", "", bounds=(0, None), per="pixel")
    logs = np.log(plugins.resolve(wide, Distribution("lognormal", (20.0, 2.27)), ((1, n),), "k") / 20.0)
    assert abs(logs.mean()) < 5 * 2.27 / np.sqrt(n) and abs(logs.std() / 2.27 - 1) < 5 / np.sqrt(2 * n)
    few = Distribution(
        "mixture", (), ((0.97, Distribution("normal", (1.0, 0.0))), (0.03, Distribution("normal", (9.0, 0.0))))
    )
    mixed = plugins.resolve(wide, few, ((1, n),), "k")
    assert set(np.unique(mixed)) == {1.0, 9.0}
    assert abs((mixed == 9).mean() - 0.03) < 5 * np.sqrt(0.03 * 0.97 / n)
    assert not np.array_equal(plugins.resolve(wide, few, ((1, n),), "other"), mixed)


# --- entry points --------------------------------------------------------------------------------------------------


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[importlib.metadata.EntryPoint]]:
    """Entry points as if packages were installed; discovery has yet to run."""
    points: list[importlib.metadata.EntryPoint] = []

    def entry_points(**chosen: str) -> list[importlib.metadata.EntryPoint]:
        assert chosen == {"group": "spadmnist.plugins"}
        return points

    monkeypatch.setattr(importlib.metadata, "entry_points", entry_points)
    monkeypatch.setattr(plugins, "_discovered", False)
    monkeypatch.syspath_prepend(tmp_path)
    yield points
    for name in ("shop_effects", "broken_effects"):
        sys.modules.pop(name, None)


def entry(value: str) -> importlib.metadata.EntryPoint:
    return importlib.metadata.EntryPoint("shop", value, "spadmnist.plugins")


def test_an_installed_package_is_found(tmp_path: Path, installed: list[importlib.metadata.EntryPoint]) -> None:
    written(tmp_path, HALF, "shop_effects.py")
    installed.append(entry("shop_effects"))
    assert "half_light" in list(Effect.registry)
    assert plugins.source_file(Effect.registry.find("half_light")) == str(tmp_path / "shop_effects.py")


def test_an_installed_package_that_fails_is_told(
    tmp_path: Path, installed: list[importlib.metadata.EntryPoint]
) -> None:
    written(tmp_path, "1 / 0\n", "broken_effects.py")
    installed.append(entry("broken_effects"))
    for _ in range(2):  # and again, where it is asked a second time
        with pytest.raises(EffectError, match=r"shop .*broken_effects.* ZeroDivisionError.*uninstall"):
            Effect.registry.find("detection")


def test_an_installed_package_that_is_not_there_is_told(installed: list[importlib.metadata.EntryPoint]) -> None:
    installed.append(entry("no_such_module_at_all"))
    with pytest.raises(EffectError, match="no_such_module_at_all"):
        list(Effect.registry)


# --- kinds of parameters -------------------------------------------------------------------------------------------

BEAT = (
    HEAD
    + '''class Beat(Effect, stage="arrival"):
    """The light beats: a frequency and a phase in units of nobody else's, and a time that ends at once."""

    depth = parameter(0.0, "", "depth", bounds=(0, 1), off=0.0, search=(0.01, 1))
    kilohertz = parameter(1.0, "", "frequency in kHz", bounds=(0, None), search=(0.1, 10), kind="frequency")
    turn = parameter(0.0, "", "phase in turns", search=(0, 1), kind="phase")
    ticks = parameter(50.0, "", "until here nothing beats, in ticks", bounds=(1, None), search=(1.5, 1e3), kind="edge")

    def factor(self, times, conditions):
        return 1 + 0 * times

    def maximum(self, conditions):
        return 1 + self.depth
'''
)


def test_a_parameter_is_moved_as_its_kind_says_whatever_its_unit(tmp_path: Path) -> None:
    plugins.load_file(written(tmp_path, BEAT))
    sensor = Sensor(Layout(2, 2, 1e-10, 1.0), [Effect.registry.find("detection")(pdp=0.5)], "device").resolved()
    (added,) = [c for c in candidates(sensor) if c.name == "add beat"]
    assert added.phases == (("beat", "turn"),)
    assert [d.key for d in frequencies_of(added)] == [("beat", "kilohertz")]
    assert [d.key for d in added.shapes] == [("beat", "kilohertz"), ("beat", "ticks")]
    beside = Sensor(sensor.layout, [*sensor.effects, Effect.registry.find("beat")(depth=0.1)], "device").resolved()
    moved = {c.parameter: c for c in candidates(beside) if c.effect == "beat" and c.kind == "set"}
    assert set(moved) == {"depth", "ticks"}  # another frequency is another candidate, another phase none
    (ticks,) = moved["ticks"].strengths
    assert is_edge(ticks) and np.allclose(
        np.array(first_strengths(ticks)) / 50 - 1, [0.1, 0.01, 0.003, -0.003, -0.01, -0.1]
    )
    (depth,) = moved["depth"].strengths
    assert not is_edge(depth) and len(first_strengths(depth)) == 1


def test_a_phase_needs_no_range(tmp_path: Path) -> None:
    """`rad` without `off` is a phase, with `search` and without: it is another one in each capture all the same."""
    turned = 'turn = parameter(0.0, "", "phase in turns", search=(0, 1), kind="phase")'
    assert turned in BEAT
    plugins.load_file(written(tmp_path, BEAT.replace(turned, 'turn = parameter(0.0, "rad", "phase", needs="depth")')))
    sensor = Sensor(Layout(2, 2, 1e-10, 1.0), [Effect.registry.find("detection")(pdp=0.5)], "device").resolved()
    (added,) = [c for c in candidates(sensor) if c.name == "add beat"]
    assert added.phases == (("beat", "turn"),)
    assert [d.key for d in added.shapes] == [("beat", "kilohertz"), ("beat", "ticks")]


def test_kinds_are_told_by_units_where_nothing_is_declared() -> None:
    kinds = {f"{e}.{name}": p.kind for e in Effect.registry for name, p in Effect.registry.find(e).parameters.items()}
    assert all(kind in plugins.KINDS for kind in kinds.values())
    told = {"flicker.frequency": "frequency", "flicker.phase": "phase", "dark_counts.rate": "smooth"}
    told |= {"dead_time.duration": "edge", "jitter.sigma": "time", "dead_time.paralyzable": "switch"}
    told |= {"readout_loss.queue": "count", "blinking_dark_counts.rate_on": "smooth", "print_tilt.angle": "smooth"}
    assert {key: kinds[key] for key in told} == told
    with pytest.raises(TypeError, match="'line' is none of the kinds smooth, time, edge"):
        plugins.parameter(1.0, "Hz", "", kind="line")


# --- what a plug-in imports -----------------------------------------------------------------------------------------

CONFIG = """\
seed: 1
scene: {images: {source: digits, train: 2, test: 2, rows: 8, columns: 8}, lux: [20 mlux]}
recording: {exposure: 80 us, readouts: [tr]}
reconstruct: [counts]
sensor:
  rules: device
  layout: {rows: 8, columns: 8, pixel_area: 25 um^2}
  effects: {detection: {pdp: 0.5}, half_light: {share: 0.5}}
"""
HERE = "import sys\nsys.path.insert(0, {!r})\n"


def afresh(path: Path) -> list[dict[str, str]]:
    """What a dataset says of its plug-ins where another process makes it."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "optics"]:
        del sys.modules[name]
    plugins._loaded.clear()
    Effect.registry.classes.pop("half_light", None)
    importlib.invalidate_caches()
    plugins.load_file(path)
    return identity.plugin_sources(config.build(document.parse(CONFIG, "lab.yaml"), path.parent))


@pytest.mark.parametrize(
    ("imports", "file"),
    [  # where it stands in the plug-in, or how it is said, does not matter
        ("from optics import FACTOR", "optics/__init__.py"),
        ("import optics.glass", "optics/glass.py"),
        ("from optics import glass", "optics/glass.py"),
        ("import importlib\nimportlib.import_module('optics.glass')", "optics/glass.py"),
        ("def later():\n    from optics import glass", "optics/glass.py"),
        ("import optics", "optics/glass.py"),  # which the package imports itself
    ],
)
def test_what_a_plugin_imports_is_told_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, imports: str, file: str
) -> None:
    """A dataset of another module beside the plug-in is another dataset; a plug-in that imports none is as before."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "optics").mkdir()
    (tmp_path / "optics" / "__init__.py").write_text("from . import glass\nFACTOR = 1.0\n")
    (tmp_path / "optics" / "glass.py").write_text("INDEX = 1.5\n")
    plain = afresh(written(tmp_path, HALF))
    assert [(one["file"], one["source"]) for one in plain] == [("mine.py", HALF)]
    path = written(tmp_path, HERE.format(str(tmp_path)) + imports + "\n" + HALF)
    before = afresh(path)
    assert {one["file"] for one in before} == {"mine.py", "optics/__init__.py", "optics/glass.py"}
    assert before == afresh(path)
    text = (tmp_path / file).read_text() + "MORE = 2\n"
    (tmp_path / file).write_text(text)
    (changed,) = [one for one in afresh(path) if one not in before]
    assert (changed["file"], changed["source"]) == (file, text)


def test_a_worker_imports_what_the_run_imports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "optics.py").write_text("FACTOR = 1.0\n")
    path = written(tmp_path, HERE.format(str(tmp_path)) + "from optics import FACTOR\n" + HALF)
    afresh(path)
    sent = plugins.carried()
    plugins.load_carried(sent)
    (tmp_path / "optics.py").write_text("FACTOR = 2.0\n")
    afresh(path)
    with pytest.raises(EffectError, match=r"mine\.py: the plug-in imports optics\.py, which is not the same"):
        plugins.load_carried(sent)


def test_of_what_is_installed_the_distribution_is_told(
    tmp_path: Path, installed: list[importlib.metadata.EntryPoint], monkeypatch: pytest.MonkeyPatch
) -> None:
    written(tmp_path, HALF, "shop_effects.py")
    point = entry("shop_effects")
    vars(point)["dist"] = type("Dist", (), {"name": "shop", "version": "2.1"})()
    installed.append(point)
    plugins.discover()
    told = identity.plugin_sources(config.build(document.parse(CONFIG, "lab.yaml"), tmp_path))
    assert {"distribution": "shop", "version": "2.1"} in told
    # it lies where nothing is installed, as of `pip install -e`: its version may stay while it changes
    assert [one["source"] for one in told if "file" in one] == [HALF]
