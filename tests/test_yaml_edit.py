"""A YAML file that is edited: values are read as they were set, and what was not touched stays byte for byte."""

from __future__ import annotations

import string
import subprocess
import sys
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spadmnist import document
from spadmnist.yaml_edit import Edit

TEXT = """\
# the head
%ssensor:
    name:  "x y"   # quoted
    'rules':   device
    layout: { rows: 8, columns: 010, on: yes, unset: , tiny: 1e-9 }   # as people write

    effects:     # of the chip
        # before the dead time
        dead_time:           # from the sheet
          duration:   50 ns  # at 20 C
          kind: null

        # counts in the dark, two comment
        # lines
        dark_counts: {rate: 100 Hz,    # on two lines
                      share: 'b'}
        tdc:
        # before the detection
        detection:
            pdp:
                normal: {mean: 50 %%, sigma: 1 %%}

            table: [ 1,2,   3 ]
            # behind the table
        # behind the detection
    chip_seed: &seed 3
# the end
"""


def edited(text: str, changes: dict[tuple[str, ...], Any], notes: dict[tuple[str, ...], str] | None = None) -> str:
    edit = Edit(text, "a.yaml")
    for path, value in changes.items():
        edit.set(path, value)
    for path, note in (notes or {}).items():
        edit.note(path, note)
    made = edit.text()
    assert document.dump(document.parse(made, "made").value) == document.dump(edit.value)
    return made


@pytest.mark.parametrize("start", ["", "---\n"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_lines_that_are_not_touched_stay_byte_for_byte(start: str, end: str) -> None:
    text = (TEXT % start).replace("\n", end)
    assert edited(text, {}) == text
    changes = {
        ("sensor", "effects", "dead_time", "duration"): "52 ns",
        ("sensor", "effects", "dead_time", "jitter"): "1 ns",
        ("sensor", "effects", "tdc", "resolution"): 2,
        ("sensor", "effects", "detection", "pdp"): {"file": "a, b.npy"},
        ("sensor", "effects", "crosstalk", "probability"): "1 %",
    }
    notes = dict.fromkeys(changes, "found")
    expected = (
        text.replace("duration:   50 ns  # at 20 C", "duration: 52 ns  # at 20 C  # found")
        .replace(f"kind: null{end}", f"kind: null{end}          jitter: 1 ns  # found{end}")
        .replace(f"tdc:{end}", "tdc: {resolution: 2}  # found" + end)
        .replace(
            "pdp:" + end + " " * 16 + "normal: {mean: 50 %, sigma: 1 %}" + end, 'pdp: {file: "a, b.npy"}  # found' + end
        )
        .replace(f"3 ]{end}", f"3 ]{end}        crosstalk: {{probability: 1 %}}  # found{end}")
    )
    assert edited(text, changes, notes).split("\n") == expected.split("\n")


def test_a_group_in_braces_keeps_its_line() -> None:
    text = "{sensor: {effects: {tdc: {resolution: 1 ns}}}}\n"
    assert edited(text, {("sensor", "effects", "tdc", "resolution"): "2 ns"}, {("sensor", "effects"): "x"}) == (
        "{sensor: {effects: {tdc: {resolution: 2 ns}}}}\n"
    )
    text = "effects: { tdc: { resolution: 1 ns }, a: {b: 1} }  # all\nname: [ a ]\n"
    changes = {("effects", "tdc", "resolution"): "2 ns", ("effects", "tdc", "jitter"): 3, ("effects", "c", "d"): True}
    made = edited(text, changes, dict.fromkeys(changes, "found") | {("effects", "none"): "of nothing"})
    line = "effects: {tdc: {resolution: 2 ns, jitter: 3}, a: {b: 1}, c: {d: true}}  # all  # found"
    assert made == line + "\nname: [ a ]\n"


@pytest.mark.parametrize("text", ["effects:\n", "effects: ~\n", "effects: {}  # none\n", "name: a\n", "name: a"])
def test_what_is_empty_or_missing_is_filled(text: str) -> None:
    made = document.parse(edited(text, {("effects", "tdc", "resolution"): "2 ns"}), "made").value
    assert made["effects"] == {"tdc": {"resolution": "2 ns"}}


def test_a_comment_goes_neither_when_a_value_of_several_lines_does() -> None:
    text = "a:  # of a\n  b:  # of b\n    c: 1\n    d:\n      e: 2  # of e\n\n  # before f\n  f: 3\n"
    assert edited(text, {("a", "b"): 7}) == "a:  # of a\n  b: 7  # of b\n\n  # before f\n  f: 3\n"
    assert edited(text, {("a", "b", "d", "g"): 7}) == text.replace("# of e\n", "# of e\n      g: 7\n")


def test_a_comment_goes_with_the_values_that_it_is_of() -> None:
    """Where all of these are replaced by others, and that was asked for."""
    text = "a: {b: 1, c: 2}   # of both\n# before d\nd:\n  e: 1  # of e\n  # before f\n"
    text += "  f:  # of f\n    g: 1  # of g\nh: 1\n"

    def without(*paths: str) -> str:
        edit = Edit(text, "a.yaml")
        for path in paths:
            edit.set(tuple(path), 7, comment=False)
        return edit.text()

    assert without("ab") == text.replace("b: 1", "b: 7")
    assert without("ab", "ac") == text.replace("{b: 1, c: 2}   # of both", "{b: 7, c: 7}")
    assert without("ai") == text.replace("c: 2}   #", "c: 2, i: 7}  #")
    assert without("de") == text.replace("e: 1  # of e", "e: 7")
    assert without("df") == text.replace("f:  # of f\n    g: 1  # of g", "f: 7")
    edit = Edit(text, "a.yaml")
    edit.set(("d", "e"), 1, comment=False)  # as it was
    edit.note(("d", "e"), "found")
    assert edit.text() == text.replace("# of e", "# of e  # found")


def test_texts_of_a_name_are_mapped_wherever_they_are() -> None:
    text = "file: 'a b.npy'   # one\nx: [ {file:   c}, {file: {file: d, other: d}} ]  # file: e\nfile2: f\n"
    edit = Edit(text, "a.yaml")
    edit.map_texts({"file"}, lambda name: f"../{name}")
    assert edit.text() == (
        "file: '../a b.npy'  # one\nx: [{file: ../c}, {file: {file: ../d, other: d}}]  # file: e\nfile2: f\n"
    )


def test_a_style_that_is_written_otherwise_keeps_its_values() -> None:
    """Folded text, and groups whose depth differs from one to the next."""
    for text in (
        "a:\n   b:\n    - 1\n    -\n       c: 2\nd:\n c: {e: 1}\n f:\n     g: >\n      two\n      lines\n",
        "%YAML 1.2\n---\na: {b: 1}\n...\n",
        "? a\n: {b: 1}\n",
        "a: \"b\\\n  c\"\nd: 'e\n\n  f'\n",
    ):
        made = document.parse(edited(text, {("d", "c", "new"): 2, ("a",): "x # y"}), "made").value
        assert made["a"] == "x # y" and made["d"]["c"]["new"] == 2


def test_what_ruamel_would_read_otherwise_is_written_anew() -> None:
    """It writes an entry of a group in braces that has no value as an empty text."""
    text = "# head\na: { b: 1, none: , c: 2 }\nd:   3\n"
    assert edited(text, {("d",): 4}) == text.replace("d:   3", "d: 4")
    assert edited(text, {("a", "b"): 4}) == "a:\n  b: 4\n  none: null\n  c: 2\nd: 3\n"


words = st.text(string.ascii_letters + string.digits + " _-#:,{}[]'\"&*!|>%@`~?.\t\n\u00e9\u2028", max_size=8)
numbers = st.integers(-(2**60), 2**60) | st.floats(allow_nan=False) | st.booleans() | st.none()
units = st.builds("{} {}".format, st.integers(0, 10**6), st.sampled_from(["ns", "Hz", "%", "um^2", "1/s"]))
values = words | numbers | units | st.dictionaries(units | words, words | numbers | units, max_size=3)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.dictionaries(st.sampled_from(["dead_time", "tdc", "detection", "new"]), values), words | units)
def test_what_is_written_is_read_as_it_was_set(found: dict[str, Any], parameter: str) -> None:
    changes = {("sensor", "effects", effect, parameter): value for effect, value in found.items()}
    made = edited(TEXT % "", changes, dict.fromkeys(changes, "found"))
    assert set((TEXT % "").split("\n")) - set(made.split("\n")) <= {"        tdc:"}, "the style was lost"


def test_the_round_trip_is_loaded_only_where_it_is_used() -> None:
    code = "import sys, spadmnist.cli, spadmnist.sensor_file; sys.exit('ruamel.yaml' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0
