"""Keys that come later change no old identity: a manifest names them only where they are not at their defaults.

data/keys.json holds what is written where configs say nothing, for two configs, each source of images and each effect.
No key may join those of a name that stands there, and no default may change: it would make another dataset of every
old one. What is new as a whole (an effect, a source) is in no dataset yet; its keys are noted by

    python tests/test_later.py --note
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import pytest
from pydantic import Field

from spadmnist import config, document, factory, images
from spadmnist.config import _sections
from spadmnist.effects import Effect, parameter
from spadmnist.errors import ConfigError
from spadmnist.section import LATER, Section
from spadmnist.validated import Time

KEYS = Path(__file__).parent / "data" / "keys.json"

PLAIN = """\
seed: 1
scene: {images: {source: IMAGES}, lux: [5 mlux]}
recording: {exposure: 1 ms, frames: 100, frame_time: 10 us}
sensor:
  layout: {rows: 28, columns: 28, pixel_area: 25 um^2}
  effects: {EFFECTS}
"""
# what a config may have instead
OTHER = """\
seed: 1
scene: {images: {source: digits}, irradiance: [5 nW/cm^2]}
recording: {exposure: 990 us, frames: 99, frame_time: 10 us, readouts: [counts], bits: 2}
sensor: {layout: {positions: places.csv, pixel_area: 25 um^2}, effects: {detection: {}}}
"""


# the classes of all image sources, by the word that a config names them by
SOURCES = {one.model_fields["source"].default: one for one in get_args(get_args(images.ImageSource)[0])}


def build(text: str, base: Path = Path()) -> config.Experiment:
    return config.build(document.parse(text, "lab.yaml"), base)


def plain(images: str = "digits", effects: str = "detection: {}", more: str = "") -> config.Experiment:
    return build(PLAIN.replace("IMAGES", images).replace("EFFECTS", effects) + more)


# --- what is written at its default -------------------------------------------------------------------------------

Keys = dict[str, dict[str, dict[str, Any]]]  # kind -> name -> key -> what is written for it


def sources() -> dict[str, type[Section]]:
    return {name: kind for name, kind in SOURCES.items() if kind.__module__ == images.__name__}


def effects() -> list[str]:
    return [name for name in Effect.registry if Effect.registry.find(name).__module__.startswith("spadmnist.")]


def written_now(base: Path) -> Keys:
    """base: a folder for what configs refer to."""
    (base / "places.csv").write_text("x,y\n0,0\n10,0\n")
    found: Keys = {
        "config": {"PLAIN": dict(leaves(plain().resolved)), "OTHER": dict(leaves(build(OTHER, base).resolved))},
        "source": {},
        "effect": {},
    }
    for name, kind in sources().items():
        needed = (f"{key}: some.file" for key, info in kind.model_fields.items() if info.is_required())
        found["source"][name] = plain(", ".join([name, *needed])).resolved["scene"]["images"]
    for name in effects():
        found["effect"][name] = plain(effects=f"{name}: {{}}").resolved["sensor"]["effects"][name]
    return found


def leaves(value: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """`recording.frames`, ...; sources and effects have lists of their own."""
    for key, below in value.items():
        path = f"{above}{key}"
        if not isinstance(below, Mapping):
            yield path, below
        elif path not in ("scene.images", "sensor.effects"):
            yield from leaves(below, f"{path}.")


DECLARE = {
    "config": "declare it as `KEY: Annotated[TYPE, LATER] = DEFAULT` (spadmnist/section.py)",
    "source": "declare it as `KEY: Annotated[TYPE, LATER] = DEFAULT` (spadmnist/section.py)",
    "effect": "declare it with `parameter(..., later=True)`",
}


def complaints(now: Keys, then: Keys) -> Iterator[str]:
    for kind, names in now.items():
        for name in sorted(set(names) - set(then[kind])):
            yield (
                f"the {kind} {name} is new, and no dataset names it: `python tests/test_later.py --note` notes its "
                "keys, so that those which it gets later are seen"
            )
        for name, old in then[kind].items():
            new = names.get(name, {})
            for key in sorted(set(new) | set(old)):
                what = f"{key} of the {kind} {name}"
                if key not in old:
                    yield (
                        f"{what} is written at its default, which no earlier program did, and makes another dataset of "
                        f"every old one: {DECLARE[kind]}"
                    )
                elif key not in new:
                    yield f"{what} is no longer written, but old datasets name it: write it as before"
                elif new[key] != old[key]:
                    yield (
                        f"{what} is {new[key]!r} where a config says nothing, and was {old[key]!r}: another default "
                        "makes another dataset of an old config; keep the old one"
                    )


def known() -> Keys:
    return json.loads(KEYS.read_text())


def test_no_key_has_joined_those_of_old_datasets(tmp_path: Path) -> None:
    found = list(complaints(written_now(tmp_path), known()))
    if found:
        pytest.fail("\n".join(found), pytrace=False)


def test_a_key_that_joins_is_told_with_what_to_declare() -> None:
    then: Keys = {"config": {}, "source": {"digits": {"train": 4}}, "effect": {"veil": {"loss": 0.1}}}
    assert not list(complaints(then, then))
    (said,) = complaints({**then, "source": {"digits": {"train": 4, "slant": 0}}}, then)
    assert said.startswith("slant of the source digits is written at its default") and "Annotated[TYPE, LATER]" in said
    (said,) = complaints({**then, "effect": {"veil": {"haze": 0, "loss": 0.1}}}, then)
    assert said.startswith("haze of the effect veil is written at its default") and "later=True" in said
    (said,) = complaints({**then, "effect": {**then["effect"], "fog": {"loss": 0.1}}}, then)
    assert said.startswith("the effect fog is new") and "--note" in said
    for gone in ({"digits": {}}, {}):
        (said,) = complaints({**then, "source": gone}, then)
        assert said.startswith("train of the source digits is no longer written")
    (said,) = complaints({**then, "effect": {"veil": {"loss": 0.2}}}, then)
    assert said.startswith("loss of the effect veil is 0.2 where a config says nothing, and was 0.1")


def note() -> None:
    """Add what is new as a whole; what is known stays."""
    then = known() if KEYS.exists() else {"config": {}, "source": {}, "effect": {}}
    with tempfile.TemporaryDirectory() as folder:
        now = written_now(Path(folder))
    for kind, names in now.items():
        for name in sorted(set(names) - set(then[kind])):
            then[kind][name] = names[name]
            print(f"noted: {kind} {name}")
    KEYS.write_text(json.dumps(then, indent=1, sort_keys=True) + "\n")


# --- a source -----------------------------------------------------------------------------------------------------


class Tinted(images.Uniform):
    """A source that got keys later."""

    source: Literal["tinted"] = "tinted"  # type: ignore[assignment]
    tint: Annotated[int, LATER] = 0
    fade: Annotated[Time, LATER] = Field(default="5 ns")  # type: ignore[assignment]
    words: Annotated[list[str], LATER] = Field(default_factory=lambda: ["warm"])
    note: Annotated[str | None, LATER] = None
    old: int = 7


class Scene(config._Scene):
    images: Annotated[images.Uniform | Tinted, Field(discriminator="source")]


@pytest.fixture
def tinted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(config._SECTIONS, "scene", Scene)


def identity(experiment: config.Experiment) -> dict[str, Any]:
    return factory.identity(experiment, experiment.load_images())


AT_DEFAULT = [
    "tint: 0",
    "fade: 5 ns",
    "fade: 0.005 us",
    "words: [warm]",
    "note: null",
    "tint: 0, fade: 5000 ps, note: null",
]


@pytest.mark.parametrize("keys", AT_DEFAULT)
def test_a_later_key_of_a_source_at_its_default_is_as_if_it_were_not_there(keys: str, tinted: None) -> None:
    bare, said = plain("tinted"), plain(f"tinted, {keys}")
    assert said.resolved["scene"]["images"] == {"source": "tinted", "repetitions": 10, "grey": 255, "old": 7}
    assert identity(said) == identity(bare) and document.dump(said.resolved) == document.dump(bare.resolved)


@pytest.mark.parametrize(
    ("keys", "written"),
    [
        ("tint: 1", {"tint": 1}),
        ("fade: 6 ns", {"fade": "6 ns"}),
        ("words: [warm, cold]", {"words": ["warm", "cold"]}),
        ("note: mine, tint: 3", {"tint": 3, "note": "mine"}),
    ],
)
def test_a_later_key_of_a_source_with_another_value_is_written(
    keys: str, written: dict[str, Any], tinted: None
) -> None:
    said = plain(f"tinted, {keys}")
    found = said.resolved["scene"]["images"]
    assert {key: found[key] for key in set(found) - {"source", "repetitions", "grey", "old"}} == written
    assert identity(said) != identity(plain("tinted"))
    again = build(document.dump(said.resolved))
    assert again.resolved == said.resolved and again.source == said.source


def test_a_later_key_is_still_checked(tinted: None) -> None:
    with pytest.raises(ConfigError, match="tint"):
        plain("tinted, tint: much")


def test_a_later_key_of_a_section_needs_a_default() -> None:
    with pytest.raises(TypeError, match=r"Needy\.key came later, so that old configs lack it"):

        class Needy(Section):
            key: Annotated[int, LATER]


# --- sections and the config itself -------------------------------------------------------------------------------


class Place(Section):
    shelf: int = 1


class Output(_sections._Output):
    """A section that got a key, and a group of keys, later."""

    level: Annotated[int, LATER] = 1
    place: Annotated[Place, LATER] = Place()


@pytest.mark.parametrize(
    ("given", "written"),
    [
        ("", {}),
        ("output: {level: 1}\n", {}),
        ("output: {level: 1, place: {shelf: 1}}\n", {}),
        ("output: {place: {}}\n", {}),
        ("output: {level: 2}\n", {"level": 2}),
        ("output: {place: {shelf: 2}}\n", {"place": {"shelf": 2}}),
    ],
)
def test_a_later_key_of_a_section(given: str, written: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(config._SECTIONS, "output", Output)
    assert plain(more=given).resolved["output"] == {"format": "zarr", **written}


@pytest.mark.parametrize(("given", "written"), [("", {}), ("noise: 0\n", {}), ("noise: 2\n", {"noise": 2})])
def test_a_later_entry_of_a_config(given: str, written: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    before = plain().resolved
    monkeypatch.setitem(config._SECTIONS, "noise", Annotated[int, LATER])
    monkeypatch.setitem(config._DEFAULTS, "noise", 0)
    assert plain(more=given).resolved == {**before, **written}


# --- effects ------------------------------------------------------------------------------------------------------


@pytest.fixture
def veil() -> None:
    class Veil(Effect, stage="light"):
        """Part of the light is lost on the way; how much of it is haze came later."""

        loss = parameter(0.1, "", "share that is lost", bounds=(0, 1), off=0.0)
        haze = parameter(0.0, "", "share of it that comes back", bounds=(0, 1), per_pixel=True, later=True)
        drift = parameter(5e-9, "s", "how fast", later=True)
        kind = parameter("dust", "", "of what", choices=("dust", "rain"), later=True)
        wet = parameter(False, "bool", "is it wet", later=True)

        def apply(self, rate: np.ndarray, conditions: Any) -> np.ndarray:
            return rate * (1 - self.loss * (1 - np.asarray(self.haze)))


@pytest.mark.parametrize(
    ("given", "written"),
    [
        ("", {}),
        ("haze: 0", {}),
        ("haze: 0 %", {}),
        ("drift: 0.005 us, kind: dust, wet: false", {}),
        ("haze: 0.2", {"haze": 0.2}),
        ("haze: {normal: {mean: 0, sigma: 0}}", {"haze": {"normal": {"mean": 0, "sigma": 0}}}),
        ("drift: 6 ns, kind: rain, wet: true", {"drift": "6 ns", "kind": "rain", "wet": True}),
    ],
)
def test_a_later_parameter_of_an_effect(given: str, written: dict[str, Any], veil: None) -> None:
    bare = plain(effects="veil: {}")
    said = plain(effects=f"veil: {{{given}}}")
    assert said.resolved["sensor"]["effects"]["veil"] == {"loss": 0.1, **written}
    assert (identity(said) == identity(bare)) == (not written)
    assert build(document.dump(said.resolved)).resolved == said.resolved


def test_a_later_parameter_is_not_required() -> None:
    with pytest.raises(TypeError, match="share: it came later, so that old configs lack it"):
        parameter(0.1, "", "share", required=True, later=True)


if __name__ == "__main__":
    if sys.argv[1:] != ["--note"]:
        sys.exit(f"usage: python {sys.argv[0]} --note   (notes the keys of new effects and sources)")
    note()
