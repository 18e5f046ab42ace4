"""The pages that the documentation makes from the classes: whatever is registered has its place there."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest

import spadmnist
from spadmnist import errors, schema, signatures, testing
from spadmnist.cli import cli
from spadmnist.effects import Effect
from spadmnist.inference import results
from spadmnist.library.answers import Fit
from spadmnist.plugins import parameter
from spadmnist.reconstruct import Method
from spadmnist.statistics import Statistic
from spadmnist.statistics.checks import Check

sys.path.insert(0, str(Path(__file__).parents[1] / "docs"))

import _pages
from _pages import answers, curves, formats, gallery, keys, markdown, modules, pictures, reference, verbs


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages without their pictures, which take a second each."""
    drawn = pictures.Picture(b"picture", b"thumbnail", ("Rate: 2 instead of 1",))
    monkeypatch.setattr(pictures, "picture", lambda effect, known: drawn)


@pytest.fixture
def haze() -> Iterator[type[Effect]]:
    class Haze(Effect, stage="light"):
        """A dirty window: the light is less.

        Source: none.
        """

        moves = ("level",)
        share = parameter(0.1, "", "share of the light that is lost", bounds=(0, 1), off=0.0, search=(0.01, 0.9))

        def apply(self, rate: Any, conditions: Any) -> Any:
            """rate (1 - share)."""
            return rate * (1 - self.share)

        expected_rate = apply

    try:
        yield Haze
    finally:
        del Effect.registry.classes["haze"]


def section(page: str, title: str) -> str:
    """What stands on a page under a heading of the second level."""
    found = re.search(rf"^## {re.escape(title)}$(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL)
    assert found, f"there is no section {title}"
    return found.group(1)


# --- verbs --------------------------------------------------------------------------------------------------------


def commands() -> dict[str, click.Command]:
    context = click.Context(cli)
    found = {name: cli.get_command(context, name) for name in cli.list_commands(context)}
    return {name: command for name, command in found.items() if command is not None}


def test_every_verb_and_option_is_on_the_page_of_verbs() -> None:
    page = verbs.page()
    for name, command in commands().items():
        text = section(page, name)
        for option in (one for one in command.params if isinstance(one, click.Option)):
            for written in option.opts:
                assert written in text, f"{name} {written} is missing"
            assert option.help, f"{name} {option.opts[0]} has no help"


def test_a_new_option_appears_on_the_page_of_verbs(monkeypatch: pytest.MonkeyPatch) -> None:
    command = commands()["verify"]
    monkeypatch.setattr(command, "params", [*command.params, click.Option(["--planted"], help="A new one.")])
    assert "`--planted TEXT` | A new one." in section(verbs.page(), "verify")


# --- keys of files ------------------------------------------------------------------------------------------------


def properties(part: Any, under: str = "") -> Iterator[tuple[str, Any]]:
    """(key, its schema) of every mapping in a schema, but for the effects."""
    if isinstance(part, list):
        for one in part:
            yield from properties(one)
    if isinstance(part, dict):
        for key, one in part.items():
            if key == "properties" and "file" not in one and not {"normal", "red", "mean", "median"} & set(one):
                yield from one.items()
            if key not in ("effects",) and not key.startswith("Distribution"):
                yield from properties(one)


@pytest.mark.parametrize("kind", schema.kinds())
def test_every_key_of_a_file_is_explained_on_its_page(kind: str) -> None:
    page = keys.page(kind)
    known = {key for key, _ in properties(schema.of(kind))}
    assert known, "the schema has no keys"
    for key in known:
        assert re.search(rf"^\| `{key}` \|", page, re.MULTILINE), f"{kind}: {key} is missing"
    for row in re.findall(r"^\| `(\w+)` \| (.*?) \| (.*?) \|", page, re.MULTILINE):
        assert row[0] in ("source", "kind", "modality") or row[1], f"{kind}: {row[0]} is not explained"
        assert row[2], f"{kind}: {row[0]} does not say what it may be"


def test_the_range_of_a_share_is_told_with_its_open_end() -> None:
    assert re.search(r"^\| `fill_factor` \| .* \| number more than 0 and at most 1 or ", keys.page("sensor"), re.M)
    assert re.search(r"^\| `own_uncertainty` \| .* \| number from 0 to 1 or ", keys.page("measurement"), re.M)


def test_a_new_key_appears_on_the_page_of_its_file(monkeypatch: pytest.MonkeyPatch) -> None:
    made = schema.of("measurement")
    made["properties"]["planted"] = {"type": "integer", "minimum": 3, "description": "a new key"}
    monkeypatch.setattr(schema, "of", lambda kind: made)
    assert "| `planted` | a new key | whole number from 3 |" in keys.page("measurement")


# --- effects ------------------------------------------------------------------------------------------------------


def test_every_effect_has_a_page_with_its_parameters(no_pictures: None, haze: type[Effect], tmp_path: Path) -> None:
    made = gallery.pages(tmp_path)
    assert "haze" in Effect.registry
    for name in Effect.registry:
        page = str(made[f"{name}.md"])
        cls: type[Effect] = Effect.registry.find(name)
        for key, declared in cls.parameters.items():
            assert f"| `{key}` | {markdown.plain(declared.about)} |" in page, f"{name}: {key} is missing"
        assert f"]({name}.png)" in page and f"{name}: {{" in page
        assert f"[`{name}`]({name}.md)" in str(made["index.md"]), f"{name} is missing on the overview"
        assert {f"{name}.png", f"{name}.thumbnail.png"} <= set(made)
    assert "**Mean rate.** rate (1 - share)." in str(made["haze.md"])


def test_an_effect_of_a_plug_in_has_a_picture_of_what_it_does(haze: type[Effect], tmp_path: Path) -> None:
    made = pictures.picture(haze, tmp_path / "haze.png")
    assert made.png.startswith(b"\x89PNG") and made.thumbnail.startswith(b"\x89PNG")
    assert re.match(r"(Detections per photon|Rate of a pixel).*: \S+( /s)? instead of \S+", made.says[0])


def test_a_picture_is_made_again_only_where_it_is_another_one(
    haze: type[Effect], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = pictures.Picture(
        pictures._drawn([], {"Source": pictures._digest(haze), "Description": "kept"}), b"small", ()
    )
    file = tmp_path / "haze.png"
    file.write_bytes(made.png)
    pictures.thumbnail_of(file).write_bytes(made.thumbnail)
    monkeypatch.setattr(pictures, "_panels", lambda effect: [])
    assert pictures.picture(haze, file).says == ("kept",)
    monkeypatch.setattr(pictures, "_REPETITIONS", 3)
    monkeypatch.setattr(pictures, "_digest", lambda effect: "another")
    assert pictures.picture(haze, file).says == ()


def test_every_statistic_of_the_contract_can_be_drawn() -> None:
    lacking = [block for block in signatures.BLOCKS if not curves.of_block(block)]
    assert not lacking
    assert {block for curve in curves.CURVES for block in curve.blocks} <= set(signatures.BLOCKS)


# --- statistics, methods, the library, formats --------------------------------------------------------------------


def test_every_statistic_says_its_law_and_what_it_shows() -> None:
    page = reference.statistics()
    for name in (*Statistic.registry, *Check.registry):
        text = section(page, name)
        for word in ("Law", "Shows", *(["Fails"] if name in Check.registry else [])):
            assert f"\n**{word}.** " in text, f"{name} does not say: {word}"


def test_every_method_and_public_name_has_a_section() -> None:
    page = reference.methods()
    for name in Method.registry:
        assert section(page, name)
    page = reference.library()
    for name in spadmnist.__all__:
        assert section(page, f"sp.{name}")
    for error in (errors.ConfigError, errors.InputError):
        assert f"`spadmnist.errors.{error.__name__}`" in section(page, "sp.SpadError")


def test_what_the_library_returns_has_a_section_in_which_all_is_explained() -> None:
    page = answers.page()
    for name in ("Comparison", "Check", "Nuisance", "Diagnosis", "Step", "Value", "Fit", "Data", "Image", "Field"):
        assert section(page, name)
    assert "from `sp.fit`" in section(page, "Fit") and "from `Diagnosis.steps`, `Fit.steps`" in section(page, "Step")
    for cls in answers.classes():
        text = section(page, cls.__name__)
        assert "See the class." not in text, f"{cls.__name__}: a member has no docstring"
        assert "**Attributes**" in text or "\n: " in text or cls.__name__ == "Field", f"{cls.__name__} explains nothing"


def test_a_new_answer_appears(monkeypatch: pytest.MonkeyPatch) -> None:
    class Planted:
        """A new one.

        Attributes:
            size: of it, m.
        """

        size: float

    def planted(self: Fit) -> Any:
        """What is new."""

    Planted.__module__, planted.__module__ = results.__name__, Fit.__module__
    planted.__annotations__["return"] = "list[results.Planted]"
    monkeypatch.setattr(results, "Planted", Planted, raising=False)
    monkeypatch.setattr(Fit, "planted", property(planted), raising=False)
    page = answers.page()
    assert "`.planted`\n: What is new." in section(page, "Fit")
    assert "from `Fit.planted`" in section(page, "Planted") and "- size: of it, m." in section(page, "Planted")


def test_every_module_that_readers_import_has_a_section() -> None:
    page = modules.page()
    for name in ("torch", "testing", "statistics", "grids", "cluster"):
        assert section(page, f"spadmnist.{name}")
    for name in (*testing.__all__, "Fluxes", "Simulated", "stream", "shipped", "srgb_to_light"):
        assert re.search(rf"^### {name}$", page, re.MULTILINE), f"{name} is missing"
    assert "0x" not in page, "an address of an object is another one at each build"


def test_a_module_is_read_without_the_package_that_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And nobody who imports it later takes the stand-in for the package."""
    (tmp_path / "planted.py").write_text(
        "from no_such_package.deep import Base, one\n\n\n"
        'class Mine(Base[int]):\n    """Of that package."""\n\n'
        "    def __init__(self, size):\n        self.size = size\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    found = modules.imported("planted")
    assert found.Mine.__doc__ == "Of that package." and found.Mine(3).size == 3
    assert not {"planted", "no_such_package", "no_such_package.deep"} & sys.modules.keys()
    with pytest.raises(ImportError, match="no_such_package"):
        import planted  # type: ignore[import-not-found]  # noqa: F401


def test_every_key_of_a_json_answer_is_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(formats.answers()) == {f"spadmnist-{name}/1" for name in ("comparison", "diagnosis", "fit")}
    for data in formats.answers().values():
        assert {key for key, _ in formats.keys(data)} <= set(formats.MEANINGS)
    monkeypatch.setattr(formats, "answers", lambda: {"spadmnist-planted/1": {"planted": 1.0}})
    with pytest.raises(KeyError, match="planted"):
        formats.page()


# --- writing ------------------------------------------------------------------------------------------------------


def test_pages_are_written_where_they_changed_and_others_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = {"a.md": markdown.page("A", "one"), "b.md": markdown.page("B"), "b.png": b"\x89PNG"}
    monkeypatch.setattr(_pages, "CHAPTERS", {"chapter": lambda folder: dict(made)})
    _pages.make(tmp_path)
    folder = tmp_path / "docs" / "chapter"
    (folder / "own.md").write_text("# Mine\n")
    before = (folder / "a.md").stat().st_mtime_ns
    del made["b.md"], made["b.png"]
    _pages.make(tmp_path)
    assert sorted(file.name for file in folder.iterdir()) == ["a.md", "own.md"]
    assert (folder / "a.md").stat().st_mtime_ns == before
    made["a.md"] = markdown.page("A", "two")
    _pages.make(tmp_path)
    assert "two" in (folder / "a.md").read_text()


def test_text_of_docstrings_is_no_markup() -> None:
    assert markdown.plain("a_b * [c] <d> `e_f`") == r"a\_b \* \[c\] \<d\> `e_f`"
    assert markdown.paragraphs("One.\n\nMore. Law: Poisson.\nSource: Fano.") == [
        "One.",
        "More.",
        "**Law.** Poisson.",
        "**Source.** Fano.",
    ]
    assert markdown.paragraphs("Args:\n    a: one\n        more\n    b: two\nbehind") == [
        "**Args**\n\n- a: one more\n- b: two",
        "behind",
    ]
    assert markdown.paragraphs("Returns:\n    One thing\n    on two lines.") == [
        "**Returns**\n\n- One thing on two lines."
    ]
    assert markdown.paragraphs("So:\n\n    import one\n\n    two()\n\nend") == [
        "So:",
        "```text\nimport one\n\ntwo()\n```",
        "end",
    ]
