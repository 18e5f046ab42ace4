"""What others wrote, a name or a text, moves no cursor, ends no line and turns no text round; hints can be pasted."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import subprocess
import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_factory import make, write_config

from spadmnist import cli, config, foreign, measurement
from spadmnist.errors import ConfigError, SpadError
from spadmnist.pages import _frame

CLEAR = "\x1b[2J\x1b[1;1H"
FAKE = f"{CLEAR}a\nout: all 9 files are as they were made\u202e\x9b\x7f\udcff\u2028"
# of a file's name: no slash, no NUL
NAMES = st.text(
    st.one_of(
        st.sampled_from(
            "\x01\t\n\r\x0b\x0c\x1b\x1c\x7f\x85\x9b\xa0\u061c\u200e\u2028\u2029\u202a\u202e\u2066\u2069\udcff"
        ),
        st.characters(exclude_characters="/\0", exclude_categories=["Cs"]),
    ),
    min_size=1,
    max_size=20,
)


def said(*arguments: str) -> tuple[int, str, str]:
    """(exit status, standard output, standard error) of `spadmnist ARGUMENTS`, in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = cli._run(list(arguments))
        except SystemExit as stop:
            status = int(stop.code or 0)
    return status, out.getvalue(), err.getvalue()


def odd(text: str) -> set[str]:
    """What is there that a terminal obeys or nobody sees, beside the ends of our own lines."""
    return {c for c in text if c != "\n" and not c.isprintable()}


@given(NAMES)
def test_what_cannot_be_seen_is_its_number(name: str) -> None:
    shown = foreign.visible(name)
    assert shown.isprintable() and (shown == name) == name.isprintable()
    assert foreign.visible_lines(f"{name}\n{name}").count("\n") == 2 * name.count("\n") + 1
    assert not odd(foreign.visible_lines(name))


@settings(max_examples=20, deadline=None)
@given(st.lists(NAMES, min_size=1, max_size=20))
def test_what_is_pasted_is_the_word_itself(names: list[str]) -> None:
    words = " ".join(map(foreign.quoted, names))
    assert words.isprintable()
    told = subprocess.run(["bash", "-c", f"printf '%s\\0' {words}"], capture_output=True, check=True).stdout
    assert told.split(b"\0")[:-1] == [os.fsencode(f"./{n}" if n.startswith("-") else n) for n in names]


WAYS: tuple[tuple[str, ...], ...] = (
    ("verify", "NAME"),
    ("inspect", "NAME"),
    ("inspect", ".", "--plot", "NAME"),
    ("generate", "NAME"),
    ("generate", "NAME", "--plugin", "NAME"),
    ("reconstruct", "NAME"),
    ("reconstruct", ".", "--method", "NAME"),
    ("simulate", "NAME", "NAME", "-o", "NAME"),
    ("import", "NAME", "-o", "NAME"),
    ("export", "NAME", "-o", "NAME", "--format", "npz"),
    ("effects", "NAME"),
    ("effects", "--new", "NAME"),
    ("compare", "NAME", "NAME", "--tolerance", "NAME"),
    ("compare", "NAME", "NAME", "--crop", "NAME"),
    ("diagnose", "NAME", "NAME"),
    ("fit", "NAME", "NAME", "-o", "NAME", "--add", "NAME"),
    ("--NAME",),
    ("NAME",),
    ("methods", "NAME", "NAME"),
)


@pytest.mark.parametrize("way", WAYS, ids=" ".join)
@settings(max_examples=25, deadline=None)
@given(name=NAMES)
def test_no_verb_prints_what_cannot_be_seen(way: tuple[str, ...], name: str) -> None:
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        status, out, err = said(*(word.replace("NAME", name) for word in way))
    assert not odd(out + err)
    # a name has no line of its own: a mistake is told in one, or in the four of how to call a verb
    assert status == 0 or len((out + err).splitlines()) <= 5


def test_verify_is_not_made_to_say_that_all_is_well(tmp_path: Path) -> None:
    """The names of files that are extra are anybody's."""
    root = tmp_path / f"o{FAKE}"
    make(write_config(tmp_path / "small.yaml", "zarr", ("5 mlux",), train=4, test=2), root)
    (root / FAKE).write_bytes(b"")
    status, out, err = said("verify", str(root))
    assert status == 1 and not odd(out + err)
    assert len(out.splitlines()) == 2 and out.startswith(r"extra: \x1b[2J")
    # the hint works
    hint = out.splitlines()[1].partition("; spadmnist verify ")[2].partition(" --repair")[0]
    told = subprocess.run(["bash", "-c", f"printf %s {hint}"], capture_output=True, check=True).stdout
    assert told == os.fsencode(root)
    status, out, err = said("verify", "--json", str(root))
    assert json.loads(out)["extra"] == [FAKE] and not odd(out)
    for verb in ("inspect", "reconstruct"):
        _, out, err = said(verb, str(root))
        assert not odd(out + err)


def test_the_name_of_a_sensor_is_one_line_of_a_table(tmp_path: Path) -> None:
    file = write_config(tmp_path / "small.yaml", "zarr", ("5 mlux",), train=4, test=2)
    text = file.read_text()
    named = re.sub(r"\n  name: .*\n", lambda _: '\n  name: "a\\nb\\e[31m\\u202e"\n', text)
    assert named != text
    file.write_text(named)
    make(file, tmp_path / "out")
    _, out, err = said("inspect", str(tmp_path / "out"))
    assert not odd(out + err) and r"a\x0ab\x1b[31m\u202e" in out


def test_a_plugins_text_moves_no_cursor(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "from spadmnist.effects import Effect, parameter\n\n\n"
        'class Mine(Effect, stage="dark"):\n'
        '    """Clears \\x1b[2J the \\u202e screen.\n\n    More \\x9b.\n    """\n\n'
        '    rate = parameter(0.0, "Hz", "of \\x1b[31m it", off=0.0)\n\n'
        "    def apply(self, rate, conditions):\n        return rate\n"
    )
    for arguments in (["effects", "mine"], ["effects"]):
        status, out, err = said(*arguments, "--plugin", str(file))
        assert status == 0, err
        assert not odd(out + err) and r"\x1b[2J" in out


def test_a_page_has_no_marks_of_direction(tmp_path: Path) -> None:
    page = _frame.write(tmp_path, "comparison", "{{ name }}<p>{{ name | upper }}", {"name": "<b>\x1b\u202eabc\x9b"})
    text = page.read_text()
    assert not odd(text) and r"&lt;b&gt;\x1b\u202eabc\x9b" in text


SECRETS = {
    "passwords": "root:$6$SECRET.abc:19000:0:99999:7:::\ndaemon:SECRET:19000:0:99999:7:::\n",
    "twice": "root:$6$SECRET.abc:19000:0:99999:7:::\n" * 2,
    "variables": "PASSWORD=SECRETsecret\n",
    "alias": "a: *SECRET\n",
    "anchor": "a: &SECRET 1\nb: &SECRET 2\n",
    "handle": "a: !SECRET!x 1\n",
    "escape": 'a: "\\qSECRET"\n',
    "key": "-----BEGIN PRIVATE KEY-----\nSECRET\n",
    "binary": "\x00SECRET",
}


@pytest.mark.parametrize("kind", SECRETS)
@pytest.mark.parametrize("read", [config.read, config.read_sensor, measurement.open])
def test_a_file_that_is_no_config_is_not_quoted(kind: str, read: object, tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    file.write_text(SECRETS[kind])
    with pytest.raises(SpadError) as error:
        read(file)  # type: ignore[operator]
    assert "SECRET" not in str(error.value) and "a.yaml" in str(error.value)


def test_what_a_parser_says_of_signs_stays(tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    file.write_text("seed: [1, 2\nscene: 3\n")
    with pytest.raises(ConfigError, match=r"a.yaml:2: is not well-formed YAML: expected ',' or '\]', but got '<.*>'|:"):
        config.read(file)


def deep(kind: str, depth: int) -> str:
    """Groups within groups, whole as a parser sees it; `[`: JSON and YAML, `- `: YAML."""
    return {"{": '{"a": ' * depth + "1" + "}" * depth, "[": "[" * depth + "]" * depth, "-": "- " * depth + "1"}[kind]


@pytest.mark.parametrize("depth", [70, 990, 100_000])
@pytest.mark.parametrize("kind", ["{", "["])
def test_json_nested_too_deeply(kind: str, depth: int) -> None:
    text = deep(kind, depth)
    with pytest.raises(ValueError, match=r"^it is nested more than 64 deep$"):
        foreign.from_json(text)
    with pytest.raises(ValueError, match=r"^it is not JSON$"):
        foreign.from_json(deep(kind, 60)[:-1])
    assert foreign.short(text) == text if depth == 70 else len(foreign.short(text)) < 2001
    assert foreign.from_json(deep(kind, 60)) is not None


@pytest.mark.parametrize("depth", [60, 5000])
@pytest.mark.parametrize("kind", ["{", "[", "-"])
@pytest.mark.parametrize("read", [config.read, config.read_sensor, measurement.open])
def test_yaml_nested_too_deeply(read: object, kind: str, depth: int, tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    for before in ("", "sensor: {effects: "):
        text = deep(kind, depth) + ("}" if before.endswith("{effects: ") and kind != "-" else "")
        file.write_text(before + ("\n" if kind == "-" else "") + text)
        with pytest.raises(SpadError) as error:
            read(file)  # type: ignore[operator]
        assert "deep" in str(error.value) or kind == "-", error.value
        assert len(str(error.value)) < 400 + len(str(file)) and "\n" not in str(error.value)


@pytest.mark.parametrize("depth", [70, 990, 100_000])
def test_files_of_a_dataset_nested_too_deeply(depth: int, tmp_path: Path) -> None:
    """The manifest, the description of an array, the plan of a run that is not finished."""
    root = tmp_path / "out"
    file = write_config(tmp_path / "c.yaml", train=2, test=1)
    make(file, root)
    arrays = sorted(root.rglob("*.zip"))
    for path in (arrays[-1], root / "manifest.json", root / ".spadmnist" / "plan.json"):
        before = path.read_bytes() if path.exists() else b""
        path.parent.mkdir(exist_ok=True)
        path.write_text(deep("{", depth))
        for verb in (("inspect", str(root), "--json"), ("verify", str(root)), ("generate", str(file), "-o", str(root))):
            status, out, err = said(*verb)
            assert status in (0, 1, 2) and "fault of the program" not in err and len(err) < 1000, (verb, err[-300:])
            assert status == 0 or len(out) + len(err.strip()) > 0
            assert all(line.startswith("Error: ") for line in err.splitlines() if status == 2), err
        if before:
            path.write_bytes(before)


@pytest.mark.slow
def test_mistakes_without_end(tmp_path: Path) -> None:
    """A file of a hundred thousand wrong entries is answered in a screen of lines, and by no endless line."""
    file = tmp_path / "a.yaml"
    file.write_text("\n".join(f"entry_{n}: 1" for n in range(30_000)) + f"\nseed: {'x' * 100_000}\n")
    status, _, err = said("generate", str(file), "-o", str(tmp_path / "out"))
    assert status == 2 and len(err.splitlines()) < 50 and max(map(len, err.splitlines())) <= 2000
    assert re.search(r"Error: there are [\d,]+ mistakes more", err)
