"""YAML as people mean it: what is read, what is refused and where, and that what is written reads back."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pace import within

from spadmnist import document
from spadmnist.errors import ConfigError, InputError, SpadError


def value_of(text: str) -> Any:
    return document.parse(text, "f.yaml").value


def problems(text: str) -> tuple[str, ...]:
    """What is wrong with a text: one line each, found in less than a second."""
    with within(1), pytest.raises(ConfigError) as caught:
        document.parse(text, "f.yaml")
    assert caught.value.problems and all(p.startswith("f.yaml") and "\n" not in p for p in caught.value.problems)
    return caught.value.problems


# --- numbers, switches and text as version 1.2 has them -----------------------------------------------------


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-9", 1e-9), ("1e9", 1e9), ("5e-3", 5e-3), ("1E+2", 100.0), ("-1.5e3", -1500.0), (".5", 0.5),
        ("1.", 1.0),
        ("0", 0), ("-7", -7), ("+7", 7), ("010", 10), ("0o17", 15), ("0x1F", 31),
        ("123456789012345678901", 123456789012345678901),
        ("yes", "yes"), ("no", "no"), ("on", "on"), ("off", "off"), ("y", "y"), ("n", "n"), ("Yes", "Yes"),
        ("NO", "NO"),
        ("true", True), ("True", True), ("TRUE", True), ("false", False), ("False", False), ("tRUE", "tRUE"),
        ("null", None), ("~", None), ("", None), ("Null", None), ("nUll", "nUll"),
        ("12:30:45", "12:30:45"), ("1:30", "1:30"), ("2024-01-01", "2024-01-01"), ("1_000", "1_000"),
        ("0b11", "0b11"),
        ("50 ns", "50 ns"), ("0.5 %", "0.5 %"), ("120 nW/cm^2", "120 nW/cm^2"), ("9**9**9", "9**9**9"),
        ("+", "+"), (".", "."),
        ("<<", "<<"), ("=", "="), ("'010'", "010"), ('"true"', "true"), ('"\\u00b5s"', "\u00b5s"),
        ("!!str 5", "5"),
    ],
)  # fmt: skip
def test_a_scalar(text: str, value: Any) -> None:
    read = value_of(f"a: {text}")["a"]
    assert read == value and type(read) is type(value)


@pytest.mark.parametrize("text", [".inf", ".Inf", ".INF", "+.inf", "-.inf", "-.INF"])
def test_infinities(text: str) -> None:
    assert value_of(f"a: {text}")["a"] == (-math.inf if text[0] == "-" else math.inf)


@pytest.mark.parametrize("text", [".nan", ".NaN", ".NAN"])
def test_nan(text: str) -> None:
    assert math.isnan(value_of(f"a: {text}")["a"])


def test_comments_blocks_and_flow() -> None:
    text = "# c\na: 1  # one\nb:\n  - {c: 5 mlux, d: [1, 2]}\n  - 'x # y'\ne: |\n  two\n  lines\n"
    assert value_of(text) == {"a": 1, "b": [{"c": "5 mlux", "d": [1, 2]}, "x # y"], "e": "two\nlines\n"}


@pytest.mark.parametrize("text", ["", "# nothing\n", "---\n"])
def test_an_empty_file_is_nothing(text: str) -> None:
    assert value_of(text) is None


def test_a_merge_key_is_a_plain_key() -> None:
    assert value_of("<<: {a: 1}\nb: 2") == {"<<": {"a": 1}, "b": 2}


def test_a_directive_does_not_bring_version_1_1_back() -> None:
    assert value_of("%YAML 1.1\n---\na: yes") == {"a": "yes"}


# --- refusals -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "first", "second", "key"),
    [
        ("a: 1\nb: 2\na: 3\n", 1, 3, "a"),
        ("a:\n  b: 1\n  c: 2\n\n  b: 3\n", 2, 5, "b"),
        ("a: {b: 1,\n    b: 2}\n", 1, 2, "b"),
        ("a: 1\n'a': 2\n", 1, 2, "a"),
        ("- {x: 1}\n- {x: 1, y: 2,\n   x: 3}\n", 2, 3, "x"),
    ],
)
def test_a_key_that_stands_twice_is_refused_with_both_lines(text: str, first: int, second: int, key: str) -> None:
    (problem,) = problems(text)
    assert problem.startswith(f"f.yaml:{second}: ") and f"line {first}" in problem and f" {key} " in problem


def test_all_keys_that_stand_twice_are_told_at_once() -> None:
    found = problems("a: 1\na: 2\nb: {c: 1, c: 2}\nd: *x\n".replace("d: *x\n", "a: 3\n"))
    assert [p.split(": ")[0] for p in found] == ["f.yaml:2", "f.yaml:3", "f.yaml:4"]


def test_an_alias_is_refused() -> None:
    found = problems("a: &x 1\nb: 2\nc: *x\n")
    assert len(found) == 1 and "alias" in found[0]


def test_a_cycle_is_refused() -> None:
    assert "alias" in problems("a: &a [*a]\n")[0]


def test_a_few_bytes_of_aliases_do_not_grow() -> None:
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 9)]
    assert "alias" in problems("\n".join(lines))[0]


@pytest.mark.parametrize("depth", [60, 200, 500, 1000])
@pytest.mark.parametrize(("before", "after"), [("[", "]"), ("{a: ", "}")])
def test_what_is_nested_deeply_is_refused(depth: int, before: str, after: str) -> None:
    assert "nested" in problems("a: " + before * depth + after * depth)[0]


def test_blocks_that_are_nested_deeply_are_refused() -> None:
    assert "nested" in problems("\n".join(" " * i + "a:" for i in range(500)))[0]


def test_forty_deep_is_read() -> None:
    value = value_of("a: " + "[" * 40 + "]" * 40)["a"]
    for _ in range(39):
        (value,) = value
    assert value == []


@pytest.mark.parametrize(
    "tag", ["!!python/name:os.system", "!!python/object/apply:os.system", "!own", "!!binary", "!!timestamp"]
)
def test_a_tag_is_refused(tag: str) -> None:
    (problem,) = problems(f"a: 1\nb: {tag} x\n")
    assert problem.startswith("f.yaml:2: ") and "tag" in problem and tag.strip("!") in problem


@pytest.mark.parametrize("tag", ["!!python/object/new:os.system", "!own", "!!set", "!!omap", "!!str"])
@pytest.mark.parametrize("text", ["{c: 1}", "[1, 2]", "\n  c: 1", "\n  - 1"])
def test_a_tag_of_a_group_or_a_list_is_refused(tag: str, text: str) -> None:
    (problem,) = problems(f"a: 1\nb: {tag} {text}\n")
    assert problem.startswith("f.yaml:2: b: the tag ") and tag.strip("!") in problem
    assert "the tag" in problems(f"{tag}\na: 1\n")[0]


def test_the_usual_tags_of_groups_and_lists_are_fine() -> None:
    assert document.parse("!!map {a: !!seq [1], b: !!map {c: 2}}", "f.yaml").value == {"a": [1], "b": {"c": 2}}


def test_a_tag_by_another_name_is_refused() -> None:
    assert "tag" in problems("%TAG ! tag:yaml.org,2002:\n---\na: !python/name:os.system x\n")[0]


@pytest.mark.parametrize("text", ["!!bool maybe", "!!int x", "!!float x", "!!null x"])
def test_a_tag_that_does_not_fit_its_text_is_refused(text: str) -> None:
    (problem,) = problems(f"a: 1\nb: {text}\n")
    assert problem.startswith("f.yaml:2: ")


@pytest.mark.parametrize("number", ["9" * 5000, "-" + "9" * 5000, "0x" + "f" * 5000, "0o" + "7" * 6000])
def test_a_whole_number_of_5000_digits_is_refused(number: str) -> None:
    (problem,) = problems(f"a: 1\nb: {number}\n")
    assert problem.startswith("f.yaml:2: ") and len(problem) < 200


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("\ta: 1", 1),
        ("a:\n\tb: 1", 2),
        ("a: 1\nb: [1,", 2),
        ("a: 1\nb: 'x", 2),
        ("a: 1\nb: c: 2", 2),
        ("a: 1\n- 2", 2),
        ("a: @x", 1),
        ("a: %x", 1),
        ("a: 1\n---\nb: 2", 2),
        ("? [a]\n: 1", 1),
        ("a: 1\n? {b: 1}\n: 1", 2),
        ("a: *nowhere", 1),
    ],
)
def test_what_is_not_well_formed_is_refused_with_its_line(text: str, line: int) -> None:
    assert problems(text)[0].startswith(f"f.yaml:{line}: ")


@pytest.mark.parametrize("text", ["a: \x07", "a: \x00b", "\x01", "a: \x7f", "a: '\ufffe'"])
def test_control_characters_are_refused(text: str) -> None:
    problems(text)


@given(st.text(max_size=80) | st.text(alphabet="ab:-[]{},&*!|>'\"%@` \n\t#?~.0e1", max_size=60))
@settings(max_examples=100, deadline=None)
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        document.parse(text, "f.yaml")
    except SpadError as error:
        assert str(error).startswith("f.yaml")


# --- files --------------------------------------------------------------------------------------------------


def unreadable(path: Path) -> str:
    with within(1), pytest.raises((InputError, ConfigError)) as caught:
        document.read(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    return str(caught.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    assert "no such file" in unreadable(tmp_path / "missing.yaml")
    assert "folder" in unreadable(tmp_path)
    unreadable(tmp_path / "missing.yaml" / "deeper.yaml")
    unreadable(tmp_path / ("x" * 300))


@pytest.mark.parametrize("raw", [b"\x89PNG\r\n\x1a\n\x00\x00", b"\x00" * 1000, b"\xff\xfea\x00:\x00", b"a: \xe9\n"])
def test_a_binary_file_is_refused(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "c.yaml"
    path.write_bytes(raw)
    unreadable(path)


def test_a_mark_at_the_beginning_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_bytes(b"\xef\xbb\xbfa: 1\r\nb: \xc2\xb5s\r\n")
    assert document.read(path).value == {"a": 1, "b": "\u00b5s"}


def test_a_file_of_more_than_a_megabyte_is_refused_and_not_read(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_bytes(b"a: 1 # " + b"x" * (1 << 20))
    assert "1 MiB" in unreadable(path)
    with open(path, "wb") as file:
        file.truncate(1 << 40)  # a terabyte that takes no room
    assert "1 MiB" in unreadable(path)
    path.write_bytes(b"a: 1 #" + b"x" * ((1 << 20) - 6))
    assert document.read(path).value == {"a": 1}


# --- places -------------------------------------------------------------------------------------------------


def test_places() -> None:
    read = document.parse("a: 1\nb:\n  c:\n    - {d: 1}\n    - {d: 2,\n       e: 3}\n", "f.yaml")
    assert read.place(("a",)) == "f.yaml:1: a"
    assert read.place(("b", "c")) == "f.yaml:3: b.c"
    assert read.place(("b", "c", 1, "e")) == "f.yaml:6: b.c[1].e"
    assert read.place(("b", "c", 1, "missing", 0)) == "f.yaml:5: b.c[1].missing[0]"
    assert read.place(("missing",)).endswith("missing")


# --- writing ------------------------------------------------------------------------------------------------

TRICKY = [
    "", " ", "  x", "x ", "\n", "a\nb", "a\n", "\ta", "a\tb", "1", "010", "0x10", "0o7", "1e9", "1e-9",
    ".5", "1.", ".inf", ".nan",
    "-.inf", "true", "True", "FALSE", "null", "Null", "~", "yes", "no", "on", "12:30:45", "2024-01-01",
    "50 ns", "0.5 %",
    "120 nW/cm^2", "a: b", "a:b", "a:", ":", "# x", "a #b", "a#b", "- a", "-", "?", "? a", "!a", "&a", "*a",
    "%a", "@a", "`a`",
    "'", "''", '"', '"a"', "it's", "[a]", "a]", "{a}", "a, b", "|", ">", "<<", "=", "---", "...", "\\",
    "\\n", "a\\", "\u00b5s",
    "\u65e5\u672c", "\U0001f600", "1 2", "1.2.3 ns", "5 e1", "x" * 3000, "x y " * 300,
    "a" * 5 + "/" + "b^2 % + -", "a -", "a - b",
    "a\u00a0b", "\u00a0",
]  # fmt: skip
CONTROL = [
    "a\rb",
    "a\r\nb",
    "\x07",
    "\x00",
    "\x1b[0m",
    "\x7f",
    "\x85",
    "a\u2028b",
    "\u2029",
    "\ufeff",
    "\ufffe",
    "\ud800",
]

visible = st.characters(codec="utf-8", exclude_categories=["Cc", "Cs", "Cn", "Zl", "Zp"])
short = [t for t in TRICKY if len(t) < 100]  # YAML allows no key of more than 1024 characters
keys = st.one_of(st.sampled_from(short), st.text(visible, max_size=12))
texts = st.one_of(keys, st.text(visible | st.just("\n"), max_size=30))
scalars = st.one_of(
    texts,
    st.integers(),
    st.floats(allow_nan=False, allow_infinity=False),
    st.booleans(),
    st.none(),
    st.sampled_from(TRICKY),
)
values = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(keys, inner, max_size=4),
    max_leaves=12,
)


def same(one: Any, other: Any) -> bool:
    """Equal in value and in type, all the way down; the order of entries counts."""
    if type(one) is not type(other):
        return False
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[k], other[k]) for k in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    return repr(one) == repr(other)


def round_trip(value: dict[Any, Any]) -> None:
    text = document.dump(value)
    text.encode("utf-8")
    assert text.endswith("\n")
    assert same(value_of(text), value), text[:500]
    assert document.dump(value_of(text)) == text


@given(st.dictionaries(keys, values, min_size=1, max_size=5))
@settings(max_examples=100, deadline=None)
def test_what_is_written_is_read_back(value: dict[str, Any]) -> None:
    round_trip(value)


@pytest.mark.parametrize("text", TRICKY)
def test_text_is_written_so_that_it_is_read_as_text(text: str) -> None:
    round_trip({"a": text, "b": [text, [text]], "c": {"d": text}, "e": [{"f": text}]})


@pytest.mark.parametrize("text", short)
def test_text_may_be_a_key(text: str) -> None:
    round_trip({text: 1, "b": {text: {"c": 1}}, "d": [{text: 1}]})


@pytest.mark.parametrize("text", CONTROL, ids=ascii)
def test_characters_that_cannot_be_seen_are_written_too(text: str) -> None:
    """A config may hold them, as "\\x07"; the file that a dataset keeps of it must be read again."""
    try:
        read = value_of('a: "' + "".join(f"\\u{ord(c):04x}" for c in text) + '"')
    except ConfigError:
        return  # what is refused need not be written
    assert read == {"a": text}
    round_trip(read)


@pytest.mark.parametrize(
    "number",
    [
        0,
        -1,
        10**30,
        0.1,
        1e-9,
        1e16,
        1e22,
        -1e-300,
        5e-324,
        1.7976931348623157e308,
        0.0,
        -0.0,
        1.0,
        100000.0,
        math.inf,
        -math.inf,
    ],
)
def test_numbers_are_written_exactly(number: float) -> None:
    round_trip({"a": number, "b": [number]})


@pytest.mark.parametrize("value", [{"a": {}}, {"a": []}, {"a": [[]]}, {"a": [{}]}, {"a": {"b": {}}}, {"a": {"b": []}}])
def test_empty_collections(value: dict[str, Any]) -> None:
    round_trip(value)


@pytest.mark.parametrize("key", [1, -1, 1.5, True, None])
def test_a_key_that_is_no_text(key: Any) -> None:
    round_trip({key: "a", "b": {key: 1}})


# --- one entry more -----------------------------------------------------------------------------------------------

PLAN = """\
# what is to be recorded
name: 'lab'   # in quotes
captures:
  - id: dark      # the shutter is closed
    # no lamp
    light: {kind: dark}
  -  id:
       flat
     light:
        kind: flat    # the lamp

        lux: 5 mlux   # at the sensor

     note: |
       two
       lines

  - {id: low, light: {kind: dark}}  # in braces
  - {"id": high,  # with a comment
     modality: tr}
  - {modality: tr, id: last }
  - file:   # to come
    id: empty
  - {file: , id: flow}
  - {id: tilde, file: ~}
"""
FILE = ("file", "a.h5")


@pytest.mark.parametrize(
    ("path", "after", "entry", "old", "new"),
    [
        ((), "name", ("a b", 1), "# in quotes\n", "# in quotes\na b: 1\n"),
        (("captures", 0), "id", FILE, "is closed\n", "is closed\n    file: a.h5\n"),
        (("captures", 0), "light", FILE, "{kind: dark}\n  -  id", "{kind: dark}\n    file: a.h5\n  -  id"),
        (("captures", 0, "light"), "kind", FILE, "{kind: dark}\n  -", "{kind: dark, file: a.h5}\n  -"),
        (("captures", 1), "id", FILE, "flat\n     l", "flat\n     file: a.h5\n     l"),
        (("captures", 1), "light", FILE, "# at the sensor\n", "# at the sensor\n     file: a.h5\n"),
        (("captures", 1, "light"), "kind", FILE, "# the lamp\n", "# the lamp\n        file: a.h5\n"),
        (("captures", 1), "note", FILE, "lines\n\n", "lines\n\n     file: a.h5\n"),
        (("captures", 2), "id", FILE, "id: low,", "id: low, file: a.h5,"),
        (("captures", 2), "light", FILE, "dark}}  #", "dark}, file: a.h5}  #"),
        (("captures", 3), "id", FILE, "high,", "high, file: a.h5,"),
        (("captures", 3), "modality", FILE, "modality: tr}\n  - {mod", "modality: tr, file: a.h5}\n  - {mod"),
        (("captures", 4), "id", FILE, "last }", "last, file: a.h5 }"),
        (("captures", 5), "id", FILE, "- file:   #", "- file: a.h5   #"),
        (("captures", 6), "id", FILE, "{file: ,", "{file: a.h5 ,"),
        (("captures", 7), "id", FILE, "file: ~", "file: a.h5"),
        (("captures", 7), "id", ("mean", 2.5), "tilde,", "tilde, mean: 2.5,"),
        (("captures", 0), "id", ("file", "no: 1 #"), "is closed\n", 'is closed\n    file: "no: 1 #"\n'),
        (("captures", 2), "id", ("file", "a, b}"), "id: low,", 'id: low, file: "a, b}",'),
        (("captures", 2), "id", ("x", {"y": [1, "2"]}), "id: low,", 'id: low, x: {y: [1, "2"]},'),
    ],
)
@pytest.mark.parametrize("end_of_line", ["\n", "\r\n"])
def test_an_entry_is_put_behind_another(
    path: tuple[Any, ...], after: str, entry: tuple[str, Any], old: str, new: str, end_of_line: str
) -> None:
    """And nothing else changes: no comment, no quote, no end of a line."""
    assert PLAN.count(old) == 1
    text, expected = (t.replace("\n", end_of_line) for t in (PLAN, PLAN.replace(old, new)))
    made = document.insert(text, path, after, *entry)
    assert made == expected
    value = value_of(made)
    for part in path:
        value = value[part]
    assert value[entry[0]] == entry[1]


@pytest.mark.parametrize(
    ("text", "after", "made"),
    [
        ("a: 1", "a", "a: 1\nfile: a.h5"),
        ("a: 1  # x", "a", "a: 1  # x\nfile: a.h5"),
        ("b: 2\r\na: 1", "a", "b: 2\r\na: 1\r\nfile: a.h5"),
        ("\ufeffa: 1\n", "a", "\ufeffa: 1\nfile: a.h5\n"),
        ("a:\nb: 2\n", "a", "a:\nfile: a.h5\nb: 2\n"),
        ("a:\n- 1\n- - 2\n  - x: 3 # y\n# z\nb: 2\n", "a", "a:\n- 1\n- - 2\n  - x: 3 # y\nfile: a.h5\n# z\nb: 2\n"),
        ("a: >-\n  x\nb: 2\n", "a", "a: >-\n  x\nfile: a.h5\nb: 2\n"),
        ("a: 'x\n  y'  # z\nb: 2\n", "a", "a: 'x\n  y'  # z\nfile: a.h5\nb: 2\n"),
        ("'a': \"x\"\n", "a", "'a': \"x\"\nfile: a.h5\n"),
        ("--- {a: 1}\n...\n", "a", "--- {a: 1, file: a.h5}\n...\n"),
        ("{a}\n", "a", "{a, file: a.h5}\n"),
        ("{a: 1,}", "a", "{a: 1, file: a.h5,}"),
        ("? a\n: 1\nb: 2\n", "a", "? a\n: 1\nfile: a.h5\nb: 2\n"),
        ("&x\na: 1\n", "a", "&x\na: 1\nfile: a.h5\n"),
        ("a: 1\nb: 2\nfile:\n", "a", "a: 1\nb: 2\nfile: a.h5\n"),
        ("file:", "file", "file: a.h5"),
        ("file: null # x\n", "file", "file: a.h5 # x\n"),
    ],
)
def test_an_entry_is_put_into_texts_of_all_kinds(text: str, after: str, made: str) -> None:
    assert document.insert(text, (), after, *FILE) == made


@pytest.mark.parametrize(
    ("text", "path", "after", "says"),
    [
        ("a: {b: 1}\n", ("a",), "c", "plan.yaml:1: a has no entry c"),
        ("a: {b: 1}\n", ("c",), "b", "plan.yaml:1: c is not there"),
        ("a:\n- b: 1\n", ("a", 1), "b", "a[1] is not there"),
        ("a:\n- b: 1\n", ("a", "x"), "b", "a.x is not there"),
        ("a: 1\n", ("a",), "b", "a has no entry b"),
        ("a: text\n", ("a", 0), "b", "a[0] is not there"),
        ("", (), "a", "plan.yaml has no entry a"),
        ("a: 1\nfile: b.h5\n", (), "a", "plan.yaml:2: file has a value already, b.h5; take it out"),
        ("[a: 1]", (0,), "a", "so that nothing can be put behind a; add file: a.h5 there"),
        ("a: |\n  x", (), "a", "so that nothing can be put behind a"),
    ],
)
def test_where_no_entry_can_be_put(text: str, path: tuple[Any, ...], after: str, says: str) -> None:
    with pytest.raises(InputError) as caught:
        document.insert(text, path, after, *FILE, "plan.yaml")
    assert says in str(caught.value) and "\n" not in str(caught.value)


def test_no_entry_is_put_into_what_is_not_well_formed() -> None:
    with pytest.raises(ConfigError, match=r"plan\.yaml:2: "):
        document.insert("a: 1\nb: [1,", (), "a", *FILE, "plan.yaml")


def groups(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], dict[Any, Any]]]:
    if isinstance(value, dict):
        yield path, value
    for key, held in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
        yield from groups(held, (*path, key))


class Plain(yaml.SafeDumper):
    """Writes what stands there twice twice."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


simple = st.text("ab:#-,{}'\" 1\u65e5", max_size=8)
written = st.recursive(
    simple | st.integers() | st.booleans() | st.none() | st.floats(allow_nan=False),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(simple, inner, max_size=3),
    max_leaves=12,
)
styles = st.fixed_dictionaries(
    {"default_flow_style": st.sampled_from([True, False, None]), "width": st.sampled_from([10, 80]),
     "indent": st.sampled_from([2, 4])}
)  # fmt: skip


@given(st.dictionaries(simple, written, min_size=1, max_size=3), styles, simple | st.floats(), st.data())
@settings(max_examples=150, deadline=None)
def test_any_group_takes_an_entry(value: dict[str, Any], style: dict[str, Any], new: Any, data: st.DataObject) -> None:
    """Written in blocks or braces, folded or not: the same text with a piece more, and the same value with an entry."""
    text = yaml.dump(value, Dumper=Plain, allow_unicode=True, sort_keys=False, **style)
    text = text.replace("\n", data.draw(st.sampled_from(["\n", "\r\n"])))
    text = text.rstrip() if data.draw(st.booleans()) else text
    read = value_of(text)
    path, group = data.draw(st.sampled_from([(path, group) for path, group in groups(read) if group]))
    after = data.draw(st.sampled_from(list(group)))
    made = document.insert(text, path, after, "new", new)
    before = list(group.items())
    group.clear()
    for key, held in before:
        group[key] = held
        if key == after:
            group["new"] = new
    assert same(value_of(made), read)
    common = next((i for i, (a, b) in enumerate(zip(text, made, strict=False)) if a != b), len(text))
    assert text[common:] == made[len(made) - len(text) + common :]
