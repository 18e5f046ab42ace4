"""Quantities: every unit to the last bit, and one sentence for whatever is not one."""

from __future__ import annotations

import copy
import pickle
import re
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pace import within

import spadmnist
from spadmnist import config, document, factory, importers, units, verify
from spadmnist.errors import ConfigError
from spadmnist.experiment import Level
from spadmnist.positions import read_positions
from spadmnist.recording import Light

# every unit that may be written -> the SI unit of its dimension, and its size as an exact fraction
SIZES = {
    "s": ("s", "1"),
    "ms": ("s", "1e-3"),
    "us": ("s", "1e-6"),
    "ns": ("s", "1e-9"),
    "ps": ("s", "1e-12"),
    "mHz": ("Hz", "1e-3"),
    "Hz": ("Hz", "1"),
    "kHz": ("Hz", "1e3"),
    "MHz": ("Hz", "1e6"),
    "GHz": ("Hz", "1e9"),
    "m": ("m", "1"),
    "mm": ("m", "1e-3"),
    "um": ("m", "1e-6"),
    "nm": ("m", "1e-9"),
    "m^2": ("m^2", "1"),
    "mm^2": ("m^2", "1e-6"),
    "um^2": ("m^2", "1e-12"),
    "ulux": ("lux", "1e-6"),
    "mlux": ("lux", "1e-3"),
    "lux": ("lux", "1"),
    "klux": ("lux", "1e3"),
    "W/m^2": ("W/m^2", "1"),
    "mW/m^2": ("W/m^2", "1e-3"),
    "uW/m^2": ("W/m^2", "1e-6"),
    "W/cm^2": ("W/m^2", "1e4"),
    "mW/cm^2": ("W/m^2", "1e1"),
    "uW/cm^2": ("W/m^2", "1e-2"),
    "nW/cm^2": ("W/m^2", "1e-5"),
    "pW/cm^2": ("W/m^2", "1e-8"),
    "rad": ("rad", "1"),
    "%": ("", "1e-2"),
    "": ("", "1"),
}
MICRO = ("\u00b5", "\u03bc")  # micro sign, Greek mu
DIMENSIONS = sorted({si for si, _ in SIZES.values()})


def refused(value: object, unit: str = "s") -> str:
    """The sentence with which a value is refused: one line, at once."""
    with within(1), pytest.raises(ValueError) as caught:
        units.parse(value, unit)
    sentence = str(caught.value)
    assert sentence and "\n" not in sentence
    return sentence


@pytest.mark.parametrize("written", SIZES)
def test_every_unit_has_its_size(written: str) -> None:
    si, size = SIZES[written]
    quantity = units.parse(f"5 {written}", si)
    assert float(quantity) == float(5 * Fraction(size))
    assert quantity.unit == si and quantity.text == f"5 {written}".strip()


def test_there_are_no_other_units() -> None:
    """A unit that is added must be added above, with its size."""
    known = {u for _, table, _ in units._DIMENSIONS.values() for u in table}
    assert known == set(SIZES)


@pytest.mark.parametrize("sign", MICRO, ids=ascii)
@pytest.mark.parametrize("written", [unit for unit in SIZES if unit.startswith("u")])
def test_the_micro_sign_stands_wherever_u_does(written: str, sign: str) -> None:
    si, _ = SIZES[written]
    for space in ("", " "):
        text = f"1.5{space}{sign}{written[1:]}"
        quantity = units.parse(text, si)
        assert float(quantity) == float(units.parse(f"1.5 {written}", si)) and quantity.text == text


@pytest.mark.parametrize("sign", MICRO, ids=ascii)
@pytest.mark.parametrize("text", ["5 {}", "5 {}Hz", "5 u{}s", "5 {}{}s", "5 l{}x", "5 s{}", "{}5 s", "5 {} s"])
def test_the_micro_sign_stands_nowhere_else(text: str, sign: str) -> None:
    for unit in DIMENSIONS:
        refused(text.replace("{}", sign), unit)


@given(
    st.sampled_from(sorted(SIZES)),
    st.integers(-(10**17), 10**17),
    st.integers(-30, 30),
)
def test_the_decimal_number_is_read_exactly(written: str, digits: int, exponent: int) -> None:
    """The nearest double to the exact decimal product: no unit adds a rounding of its own."""
    si, size = SIZES[written]
    quantity = units.parse(f"{digits}e{exponent} {written}", si)
    assert float(quantity) == float(digits * Fraction(10) ** exponent * Fraction(size))


@pytest.mark.parametrize(
    ("one", "other", "unit"),
    [
        ("1000 mlux", "1 lux", "lux"),
        ("2560 mlux", "2.56 lux", "lux"),
        ("0.1 us", "100 ns", "s"),
        ("10 us", "0.01 ms", "s"),
        ("1.1 kHz", "1100 Hz", "Hz"),
        ("0.5 %", "0.005", ""),
        ("100 nW/cm^2", "1 mW/m^2", "W/m^2"),
        ("25 um^2", "0.000025 mm^2", "m^2"),
        ("555 nm", "0.555 \u00b5m", "m"),
    ],
)
def test_one_value_in_two_spellings_is_one_double(one: str, other: str, unit: str) -> None:
    assert float(units.parse(one, unit)) == float(units.parse(other, unit))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("50ns", 50e-9),
        (" 50  ns ", 50e-9),
        ("5e1 ns", 50e-9),
        ("5E+1 ns", 50e-9),
        (".5 us", 0.5e-6),
        ("+50 ns", 50e-9),
        ("-1 ns", -1e-9),
        ("0 s", 0.0),
    ],
)
def test_spellings(text: str, value: float) -> None:
    assert units.parse(text, "s") == value


@pytest.mark.parametrize(("value", "number"), [(0.5, 0.5), (1, 1.0), ("0.25", 0.25), ("50%", 0.5), ("50 %", 0.5)])
def test_what_has_no_dimension_is_bare_or_in_per_cent(value: object, number: float) -> None:
    assert units.parse(value, "") == number


@pytest.mark.parametrize(
    "text",
    [
        "", "ns", "50 nS", "50 NS", "50 parsecs", "50 Hz", "50 %", "50 n s", "50 ns ns", "5.5.5 ns",
        "1_000 ns",
        "1,000 ns", "0x10 ns", "1/2 s", "--5 ns", "5 e1 ns", "nan s", "inf s", "-inf s", "Infinity s",
        ".inf s",
        "9**9**9", "9**9**9 s", "50 ns; 1", "[50 ns]", "5\x00 s", "\u00bd s", "5 \u00b2s", "1e9999 s",
        "e s", ". s",
    ],
)  # fmt: skip
def test_what_is_no_time_is_refused_with_what_to_write(text: str) -> None:
    sentence = refused(text)
    assert repr(text) in sentence and "time" in sentence and '"50 ns"' in sentence
    assert "s, ms, us, ns, ps" in sentence


@pytest.mark.parametrize("text", ["\uff15\uff10 ns", "\u0663 ns", "\u0967 ns"])
def test_digits_are_those_of_a_config(text: str) -> None:
    """Full-width, Arabic and Devanagari digits: folder names and other programs would not follow."""
    refused(text)


@pytest.mark.parametrize("value", [50, 50.0, "50", "5e1", float("nan"), float("inf"), 10**400])
def test_a_bare_number_is_told_its_unit(value: object) -> None:
    sentence = refused(value)
    assert "has no unit" in sentence and "s, ms, us, ns, ps" in sentence and '"50 ns"' in sentence


@pytest.mark.parametrize("unit", DIMENSIONS)
@pytest.mark.parametrize("value", [True, False, None, [1], {}, (1,), b"50 ns", 1j, Decimal(1), object])
def test_other_types_are_refused_in_every_dimension(value: object, unit: str) -> None:
    sentence = refused(value, unit)
    assert units.dimension_name(unit) in sentence


@pytest.mark.parametrize("unit", DIMENSIONS)
def test_every_dimension_names_itself_and_its_example_can_be_read(unit: str) -> None:
    units.parse(units.example(unit), unit)
    sentence = refused("50 parsecs", unit)
    assert units.dimension_name(unit) in sentence and units.example(unit) in sentence


@pytest.mark.parametrize("other", [d for d in DIMENSIONS if d])
@pytest.mark.parametrize("unit", DIMENSIONS)
def test_no_dimension_takes_the_unit_of_another(unit: str, other: str) -> None:
    if unit != other:
        refused(units.example(other), unit)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 10**400, "1e400", "nan", "inf"])
def test_a_number_is_finite(value: object) -> None:
    refused(value, "")


@pytest.mark.parametrize("text", ["1e400 s", "1e999 s", "-1e308 s", "9" * 400 + " s"])
def test_a_quantity_is_finite(text: str) -> None:
    if text.startswith("-"):
        assert units.parse(text, "s") == -1e308
    else:
        assert re.search("too large|is not a time", refused(text))


@pytest.mark.parametrize("text", ["9" * 900_000 + " s", "9" * 1_000_000 + " s", "1 " + "s" * 1_000_000])
def test_text_of_a_megabyte_is_refused_at_once(text: str) -> None:
    refused(text)


def test_a_quantity_travels_with_its_text() -> None:
    quantity = units.parse("50 ns", "s")
    for other in (pickle.loads(pickle.dumps(quantity)), copy.deepcopy(quantity)):
        assert (other, other.text, other.unit) == (quantity, "50 ns", "s")
    assert str(quantity) == "50 ns"
    assert units.parse(quantity, "s") is quantity
    refused(quantity, "Hz")


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (5e-8, "s", "50 ns"),
        (1e-3, "s", "1 ms"),
        (9.999e-4, "s", "999.9 us"),
        (0.0, "s", "0 s"),
        (3e4, "s", "30000 s"),
        (100.0, "Hz", "100 Hz"),
        (2.5e-11, "m^2", "25 um^2"),
        (1.2e-3, "W/m^2", "120 nW/cm^2"),
        (2.56, "lux", "2.56 lux"),
        (0.005, "", "0.005"),
        (5.55e-7, "m", "555 nm"),
    ],
)
def test_show(value: float, unit: str, text: str) -> None:
    assert units.show(value, unit) == text


@given(st.sampled_from(DIMENSIONS), st.floats(1e-11, 1e9))
def test_what_is_shown_can_be_read(unit: str, value: float) -> None:
    assert units.parse(units.show(value, unit, 17), unit) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize("unit", DIMENSIONS)
def test_what_is_shown_is_ascii(unit: str) -> None:
    """Also where people write the micro sign: a terminal or another program may not know it."""
    assert units.allowed_units(unit).isascii()
    assert all(units.show(1.5 * 10.0**k, unit).isascii() for k in range(-13, 10))
    assert units.show(units.parse("5 \u00b5s", "s"), "s") == "5 us"


def test_a_factor_of_little_is_not_nothing() -> None:
    assert [units.factor(x) for x in (1.02031, 0.0, 0.00041, 12.5)] == ["1.0203", "0.0000", "0.00041", "12.5000"]


# --- where texts go -----------------------------------------------------------------------------------------------

CONFIG = """\
seed: 1
scene: {images: {source: uniform, repetitions: 3}, wavelength: 0.5 um, lux: [5 ulux, 5 lux]}
recording: {exposure: 1000 us, frames: 10, frame_time: 100 us}
reconstruct: [counts]
sensor:
  layout: {rows: 2, columns: 3, pixel_area: 25 um^2}
  effects: {detection: {pdp: 0.5}, dead_time: {duration: 0.05 us}, tdc: {resolution: 100 ps}}
"""


@pytest.mark.parametrize("sign", MICRO, ids=ascii)
def test_a_config_with_the_micro_sign(sign: str, tmp_path: Path) -> None:
    """Its dataset keeps the text, has folders of plain letters, and is checked and simulated from its own config."""
    text = re.sub(r"(?<=\d )u", sign, CONFIG)
    assert text.count(sign) == 6
    (tmp_path / "c.yaml").write_text(text, encoding="utf-8")
    experiment, plain = config.read(tmp_path / "c.yaml"), config.build(document.parse(CONFIG, "plain.yaml"), tmp_path)
    assert experiment.conditions == plain.conditions and experiment.levels[0].key == plain.levels[0].key
    assert experiment.resolved["recording"]["frame_time"] == f"100 {sign}s"
    factory.generate(experiment, experiment.load_images(), tmp_path / "out", 1)
    assert not verify.verify(tmp_path / "out")
    assert document.read(tmp_path / "out" / "config.yaml").value["scene"]["lux"] == [f"5 {sign}lux", "5 lux"]
    assert {p.name for p in (tmp_path / "out" / "data").iterdir() if p.is_dir()} == {"5_ulux", "5_lux", "images"}
    stored, live = spadmnist.open(tmp_path / "out"), spadmnist.open(tmp_path / "out" / "config.yaml")
    assert stored.levels == live.levels == (f"5 {sign}lux", "5 lux")
    for spelling in ("5 ulux", *(f"5 {other}lux" for other in MICRO)):
        assert stored[spelling] is stored[stored.levels[0]] and experiment.level(spelling) is experiment.levels[0]
    assert stored["5 lux"].tr[:].ticks.tobytes() == live["5 lux"].tr[:].ticks.tobytes()  # type: ignore[union-attr]


@pytest.mark.parametrize("other", ["5 ulux", "5\u00b5lux", "0.005 mlux"])
def test_one_level_in_two_spellings_is_listed_once(other: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is the level 5 \u03bclux again; list it once"):
        config.build(document.parse(CONFIG.replace("5 ulux, 5 lux", f"5 \u03bclux, {other}"), "c.yaml"), tmp_path)


LEVELS = [(unit, si) for unit, (si, _) in SIZES.items() if si in ("lux", "W/m^2")]


@given(
    *[
        st.tuples(
            st.sampled_from(LEVELS), st.sampled_from(["5", "1.5", "0.5", "5e-2"]), st.sampled_from("u" + "".join(MICRO))
        )
    ]
    * 2
)
def test_levels_share_a_folder_where_they_are_one(one: tuple[tuple[str, str], str, str], other: Any) -> None:
    """Unlike texts of unlike light have unlike folders, and the spelling of the micro sign makes none."""
    levels = []
    for (unit, si), number, sign in (one, other):
        value = units.parse(f"{number} {re.sub('^u', sign, unit)}", si)
        levels.append(Level(value.text, "lux" if si == "lux" else "irradiance", float(value)))
    same = one[:2] == other[:2]
    assert (levels[0].folder == levels[1].folder) == same and all(level.folder.isascii() for level in levels)


@pytest.mark.parametrize("sign", ["u", *MICRO], ids=ascii)
def test_light_on_the_command_line(sign: str) -> None:
    assert importers.light(f"500 nm 1.5 {sign}W/cm^2") == importers.light(f"0.5 {sign}m 1.5{sign}W/cm^2")
    assert importers.light(f"500 nm 1.5 {sign}W/cm^2") == Light(500e-9, 0.015, "irradiance", 0.05)
    assert importers.light(f"5 {sign}lux") == Light(555e-9, 5e-6, "lux", 0.05)


@pytest.mark.parametrize("sign", ["u", *MICRO], ids=ascii)
def test_the_header_of_positions(sign: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(f"x ({sign}m),Y({sign}m)\n0,0\n5,-1\n", encoding="utf-8")
    assert read_positions(tmp_path / "a.csv").tolist() == [[0, 0], [5e-6, -1e-6]]


@pytest.mark.parametrize("sign", MICRO, ids=ascii)
def test_a_document_with_the_micro_sign_is_read_back(sign: str) -> None:
    value = {"a": f"5 {sign}s", f"5 {sign}m": [f"1.5 {sign}W/cm^2", {f"0.5 {sign}m": 0.4}], "b": {"c": f"x ({sign}m)"}}
    assert document.parse(document.dump(value), "c.yaml").value == value


def test_what_is_rounded_to_a_thousand_is_one_of_the_next_unit() -> None:
    assert (units.show(0.9996, "s", 3), units.show(0.9994, "s", 3), units.show(999.6e-9, "s", 3)) == (
        "1 s",
        "999 ms",
        "1 us",
    )


@pytest.mark.parametrize("written", [unit for unit in SIZES if "^2" in unit])
def test_a_square_needs_no_caret_and_is_kept_with_one(written: str) -> None:
    si, _ = SIZES[written]
    for space in ("", " "):
        quantity = units.parse(f" 8{space}{written.replace('^', '')}", si)
        assert quantity.text == f"8{space}{written}" and float(quantity) == float(units.parse(f"8 {written}", si))
        assert re.search(units.pattern(si), f"8{space}{written.replace('^', '')}")
    refused(f"8 {written.replace('^2', '3')}", si)
    refused("8 m2", "m")
