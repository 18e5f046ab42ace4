"""The command line: what it says, where it says it, and how it ends."""

from __future__ import annotations

import inspect
import io
import json
import os
import shutil
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import pytest
from click.testing import CliRunner
from commands import COMMAND, run, run_anew
from test_factory import assert_same, assert_sentence, make, tree, write_config

from spadmnist import cli as command_line
from spadmnist.cli import cli

VERBS = sorted(cli.commands)
IMPORTS = (
    "import sys; sys.argv = {argv!r}\ntry:\n    from spadmnist.cli import main; main()\nexcept SystemExit:\n    pass\n"
)


def test_a_file_of_verbs_is_found_by_being_there() -> None:
    """And `--help` lists every verb by its hour, of which no two are the same."""
    folder = Path(command_line.__path__[0])
    homes = {Path(inspect.getsourcefile(inspect.unwrap(verb.callback))) for verb in cli.commands.values()}
    assert homes == set(folder.glob("[!_]*.py"))
    listed = cli.list_commands(click.Context(cli))
    assert len(set(cli._hours.values())) == len(listed) == len(VERBS) and sorted(listed) == VERBS
    assert listed[:2] == ["generate", "init"] and listed[-1] == "experiment"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(config, dataset)."""
    home = tmp_path_factory.mktemp("made")
    file = write_config(home / "small.yaml", levels=("5 mlux", "2560 mlux"), train=20, test=6)
    make(file, home / "out")
    return file, home / "out"


# --- help ---------------------------------------------------------------------------------------------------------


def test_the_verbs_of_a_dataset_are_there() -> None:
    assert {"generate", "reconstruct", "inspect", "verify", "effects", "methods"} <= set(VERBS)


@pytest.mark.parametrize("verb", VERBS)
def test_help_names_every_option(verb: str) -> None:
    result = CliRunner().invoke(cli, [verb, "--help"])
    assert result.exit_code == 0
    for parameter in cli.commands[verb].params:
        for name in parameter.opts:
            assert (name if name.startswith("-") else name.upper()) in result.output, name
    assert "--help" in result.output
    assert max(len(line) for line in result.output.splitlines()) <= 100


def test_the_options_of_generate() -> None:
    options = {name for parameter in cli.commands["generate"].params for name in parameter.opts}
    promised = {"-o", "--lux", "--limit", "--images-dir", "--jobs", "--seed", "--format", "--dry-run", "--plugin"}
    assert promised <= options


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], *[[verb, "--help"] for verb in VERBS]])
def test_help_imports_nothing_heavy(arguments: list[str]) -> None:
    code = IMPORTS.format(argv=["spadmnist", *arguments]) + "print('LOADED', *sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    loaded = set(result.stdout.partition("LOADED")[2].split())
    assert "spadmnist.cli" in loaded, result.stderr
    assert not loaded & {"numpy", "numba", "zarr", "h5py", "scipy", "loky", "pydantic", "matplotlib", "yaml"}


def test_help_is_there_at_once() -> None:
    """The best of some, as other programs run here, too."""
    best = 9.0
    for _ in range(5):
        started = time.perf_counter()
        assert run_anew("--help").returncode == 0
        best = min(best, time.perf_counter() - started)
    assert best < 0.3


# --- exit statuses and streams ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_nothing_to_do_is_said_on_standard_error(made: tuple[Path, Path]) -> None:
    result = run("generate", made[0], "-o", made[1])
    assert result.returncode == 0
    assert "nothing was done" in result.stderr and "nothing was done" not in result.stdout
    assert "2560 mlux" in result.stdout


@pytest.mark.parametrize("option", ["--output", "--sensor"])
def test_what_belongs_to_a_measurement_is_no_option_of_a_dataset(made: tuple[Path, Path], option: str) -> None:
    before = tree(made[1])
    result = run("reconstruct", made[1], option, made[0])
    assert_sentence(result, option, "belongs to a measurement", "leave it out")
    assert tree(made[1]) == before and result.stdout == ""


@pytest.mark.slow
def test_json_is_all_that_stands_on_standard_output(made: tuple[Path, Path], tmp_path: Path) -> None:
    file, root = made
    commands: list[tuple[Any, ...]] = [
        ("generate", file, "-o", tmp_path / "out", "--limit", 3, "--jobs", 1),
        ("generate", file, "-o", root),
        ("generate", file, "-o", tmp_path / "dry", "--dry-run"),
        ("reconstruct", root),
        ("inspect", root),
        ("verify", root),
        ("effects",),
        ("effects", "dead_time"),
        ("methods",),
        ("methods", "counts"),
    ]
    for command in commands:
        result = run(*command, "--json")
        assert result.returncode == 0, result
        json.loads(result.stdout)


def test_no_colours_and_no_bars_where_there_is_no_terminal(made: tuple[Path, Path], tmp_path: Path) -> None:
    result = run("generate", made[0], "-o", tmp_path / "out", "--limit", 3, "--jobs", 1)
    assert result.returncode == 0
    for stream in (result.stdout, result.stderr):
        assert "\x1b" not in stream and "\r" not in stream and "%|" not in stream


def shell(command: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """A shell line in which `spadmnist` is this one."""
    env = {**os.environ, "PATH": f"{Path(COMMAND).parent}{os.pathsep}{os.environ['PATH']}"}
    return subprocess.run(
        ["bash", "-c", f"set -o pipefail; {command}"], capture_output=True, text=True, timeout=60, env=env, **options
    )


COMMANDS = [
    "generate {file} -o {root}",
    "generate {file} -o {root} --json",
    "inspect {root}",
    "verify {root}",
    "effects",
]


def quiet(result: subprocess.CompletedProcess[str]) -> None:
    for word in ("Traceback", "Exception ignored", "fault of the program", "BrokenPipe"):
        assert word not in result.stderr, result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_a_reader_that_goes_away(command: str, made: tuple[Path, Path]) -> None:
    for reader in ("head -c 1", "true"):
        result = shell(f"spadmnist {command.format(file=made[0], root=made[1])} | {reader}")
        quiet(result)
        assert result.returncode in (0, 1, 141), result


@pytest.mark.parametrize("command", COMMANDS)
def test_a_full_standard_output(command: str, made: tuple[Path, Path]) -> None:
    result = shell(f"spadmnist {command.format(file=made[0], root=made[1])} > /dev/full")
    quiet(result)
    assert result.returncode == 2, result
    assert "space" in result.stderr


@pytest.mark.parametrize("command", COMMANDS)
def test_a_full_standard_error_does_no_harm(command: str, made: tuple[Path, Path]) -> None:
    """What is said there is not the result."""
    result = shell(f"spadmnist {command.format(file=made[0], root=made[1])} 2> /dev/full")
    assert result.returncode == 0, result
    assert result.stdout


@pytest.mark.slow
def test_an_error_that_cannot_be_said_keeps_its_status() -> None:
    for redirected in ("2> /dev/full", "2>&-", "> /dev/full 2>&1", ">&- 2>&-"):
        assert shell(f"spadmnist verify /nonexistent {redirected}").returncode == 2, redirected


@pytest.mark.parametrize("command", [COMMANDS[0], *(pytest.param(x, marks=pytest.mark.slow) for x in COMMANDS[1:])])
def test_closed_streams(command: str, made: tuple[Path, Path]) -> None:
    for redirected in (">&-", "2>&-", "<&-", ">&- 2>&- <&-"):
        result = shell(f"spadmnist {command.format(file=made[0], root=made[1])} {redirected}")
        quiet(result)
        assert result.returncode == 0, (redirected, result)


def test_a_terminal_that_knows_ascii_alone(made: tuple[Path, Path], tmp_path: Path) -> None:
    env = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii"}
    commands: list[tuple[Any, ...]] = [("effects",), ("methods",), ("inspect", made[1]), ("--help",)]
    commands += [("effects", one["name"]) for one in json.loads(run("effects", "--json").stdout)]
    commands += [("methods", "inter_photon"), ("generate", made[0], "-o", tmp_path / "x", "--dry-run")]
    # one process for all of them: what is read at its start is the same
    code = """
import json, sys
from spadmnist import cli
for command in json.loads(sys.argv[1]):
    try:
        cli.main(command)
    except SystemExit as end:
        if end.code:
            sys.exit(f"{command}: {end.code}")
"""
    words = json.dumps([[str(word) for word in command] for command in commands])
    result = subprocess.run(
        [sys.executable, "-c", code, words], capture_output=True, text=True, timeout=120, env=env, encoding="ascii"
    )
    quiet(result)
    assert result.returncode == 0, result
    assert result.stdout.count("Usage:") >= 1 and len(commands) > 20
    result = run_anew("verify", tmp_path / "nö", env=env)
    assert_sentence(result)


# --- dry run ------------------------------------------------------------------------------------------------------


def test_dry_run_counts_photons(made: tuple[Path, Path], tmp_path: Path) -> None:
    """White is 683 lm/W at 555 nm: photons from the closed form; detections as a real run records them."""
    import numpy as np

    import spadmnist

    file = write_config(tmp_path / "c.yaml", levels=("5 mlux", "2560 mlux"), train=600, test=100)
    result = run("generate", file, "--dry-run", "--json", "--limit", 500, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    estimate = json.loads(result.stdout)
    assert sorted(tree(tmp_path)) == ["c.yaml"], "something was written"
    make(file, tmp_path / "out", limit=500)
    ds = spadmnist.open(tmp_path / "out")
    for row, lux in zip(estimate["levels"], ds.lux, strict=True):
        grey = sum(float(ds[row["level"], split].images[:].sum()) for split in ds.splits) / 255
        power = lux * 25e-12 / 683
        photons = grey * power * 555e-9 / (6.62607015e-34 * 299792458) * 1e-3
        assert row["images"] == 600
        assert row["photons"] == pytest.approx(photons, rel=1e-6)
        counted = sum(len(ds[row["level"], split].tr[:]) for split in ds.splits)
        assert abs(row["detections"] - counted) < max(0.01 * counted, 4 * counted**0.5)
        assert isinstance(row["detections"], float) and np.isfinite(row["seconds"])
    size = sum(len(c) for n, c in tree(tmp_path / "out").items() if "mlux" in n and not n.endswith(".json"))
    assert 0.5 < estimate["total"]["bytes"] / size < 2
    assert estimate["shards"] == 2 + 4


def test_dry_run_for_people(made: tuple[Path, Path], tmp_path: Path) -> None:
    result = run("generate", made[0], "-o", tmp_path / "out", "--dry-run")
    assert result.returncode == 0 and "Nothing was made" in result.stdout
    for word in ("photons", "size", "memory", "time", "5 mlux", "all"):
        assert word in result.stdout
    assert tree(tmp_path) == {}


@pytest.mark.slow
def test_dry_run_says_what_is_there(made: tuple[Path, Path], tmp_path: Path) -> None:
    file, root = made
    shutil.copytree(root, tmp_path / "out")
    before = tree(tmp_path)

    def said(*options: object) -> str:
        result = run("generate", file, "-o", tmp_path / "out", "--dry-run", *options)
        assert result.returncode == 0 and tree(tmp_path) == before, result.stderr
        return result.stderr

    assert "out is complete already: generate would do nothing." in said()
    assert "generate would stop" in said("--seed", 77) and "holds another dataset: config.seed" in said("--seed", 77)
    (tmp_path / "out" / "config.yaml").unlink()
    before = tree(tmp_path)
    assert "generate would stop" in said() and "config.yaml: this file is missing" in said()


@pytest.mark.slow
def test_a_sheet_replaces_pictures_alone(made: tuple[Path, Path], tmp_path: Path) -> None:
    sheet = tmp_path / "sheet.png"
    for content in (None, b""):
        if content is not None:
            sheet.write_bytes(content)
        for _ in range(2):
            assert run("inspect", made[1], "--plot", sheet).returncode == 0
    sheet.write_bytes(b"my only copy")
    assert_sentence(run("inspect", made[1], "--plot", sheet), "--plot", "sheet.png", "no PNG picture", "another file")
    assert sheet.read_bytes() == b"my only copy"


# --- wrong input --------------------------------------------------------------------------------------------------

WRONG = {
    "limit": (["--limit", "0"], ["--limit", "0"]),
    "jobs": (["--jobs", "0"], ["--jobs", "0"]),
    "negative seed": (["--seed", "-1"], ["--seed", "-1"]),
    "level": (["--lux", "7 mlux"], ["7 mlux", "5 mlux, 2560 mlux"]),
    "level without a unit": (["--lux", "5"], ["--lux", "5 mlux"]),
    "format": (["--format", "tiff"], ["tiff", "zarr", "hdf5"]),
    "plug-in": (["--plugin", "nothing.py"], ["nothing.py"]),
    "option": (["--lmit", "3"], ["--lmit", "--limit"]),
    "option twice": (["--seed", "1", "--seed=2"], ["--seed", "given 2 times", "give it once"]),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_options(case: str, made: tuple[Path, Path], tmp_path: Path) -> None:
    options, words = WRONG[case]
    result = run("generate", made[0], "-o", tmp_path / "out", *options)
    assert_sentence(result, *words)
    assert result.stdout == ""
    assert sum("rror" in line for line in result.stderr.splitlines()) == 1
    assert tree(tmp_path) == {}


@pytest.mark.parametrize("verb", VERBS)
def test_unknown_names(verb: str, made: tuple[Path, Path]) -> None:
    arguments = {
        "reconstruct": [made[1], "--method", "countz"],
        "effects": ["dead_tme"],
        "methods": ["countz"],
        "init": [made[0]],  # a file: a folder that is not there is made
        **{key: ["/nonexistent/nothing", made[1], "-o", "/nonexistent/out"] for key in ("simulate", "fit")},
        **{key: ["/nonexistent/nothing", made[1]] for key in ("compare", "diagnose")},
    }.get(verb, ["/nonexistent/nothing"])
    result = run(verb, *arguments)
    assert_sentence(result)
    if verb in ("reconstruct", "methods"):
        assert "Did you mean counts" in result.stderr
    if verb == "effects":
        assert "Did you mean dead_time" in result.stderr
    assert len(result.stderr.splitlines()) == 1, result.stderr
    assert result.stdout == ""


# --- an effect of one's own ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_new_effect_by_the_commands_that_are_told(made: tuple[Path, Path], tmp_path: Path) -> None:
    """What is printed is typed, one after the other."""
    told = run("effects", "--new", "light_leak", cwd=tmp_path)
    assert told.returncode == 0 and told.stderr == "" and sorted(tree(tmp_path)) == ["light_leak.py"]
    lines = told.stdout.splitlines()
    read, generate = [line.split()[1:] for line in lines if line.startswith("  spadmnist ")]
    page = run(*read, cwd=tmp_path)
    assert page.returncode == 0 and page.stdout.startswith("light_leak\nstage: dark\n")
    (entry,) = [line for line in lines if line.strip().startswith("light_leak:")]
    assert lines[lines.index(entry) - 2 : lines.index(entry)] == ["  sensor:", "    effects:"] and entry in page.stdout
    (tmp_path / "my.yaml").write_text(made[0].read_text().replace("  effects:\n", f"  effects:\n{entry[2:]}\n"))
    result = run(*generate, "--limit", 2, "--jobs", 1, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["config"]["sensor"]["effects"]["light_leak"] == {"rate": "50 Hz"}
    assert manifest["plugins"][0]["file"] == "light_leak.py"
    (python,) = [line for line in lines if line.startswith("  python -c ")]
    assert (
        python.endswith('check_effect; print(check_effect(LightLeak))"')
        and "from light_leak import LightLeak;" in python
    )


def test_a_new_effect_as_json_and_at_another_stage(tmp_path: Path) -> None:
    result = run("effects", "--new", "haze", "--stage", "light", "--json", cwd=tmp_path)
    assert json.loads(result.stdout) == {"file": "haze.py", "effect": "haze", "stage": "light"}
    assert 'stage="light"' in (tmp_path / "haze.py").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--new", "LightLeak"], ["LightLeak", "light_leak"]),
        (["--new", "../leak"], ["../leak"]),
        (["--new", "dead_time"], ["dead_time", "already"]),
        (["--new", "there"], ["there.py", "already"]),
        (["--new", "leak", "--stage", "drak"], ["'drak'", "Did you mean dark?", "correlated"]),
        (["--stage", "dark"], ["--stage", "--new"]),
        (["dead_time", "--new", "leak"], ["--new", "dead_time"]),
        (["--new", "leak", "--plugin", "broken.py"], ["broken.py:3", "ValueError: no good"]),
    ],
)
def test_a_new_effect_that_cannot_be(arguments: list[str], words: list[str], tmp_path: Path) -> None:
    (tmp_path / "there.py").write_text("mine = 1\n")
    (tmp_path / "broken.py").write_text("import spadmnist\n\nraise ValueError('no good')\n")
    before = tree(tmp_path)
    result = run("effects", *arguments, cwd=tmp_path)
    assert_sentence(result, *words)
    assert len(result.stderr.splitlines()) == 1 and result.stdout == "", result
    assert_same(tmp_path, before)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("import spadmnist\n\nx = 1 / 0\n", ["mine.py:3", "ZeroDivisionError"]),
        ("def f(:\n    pass\n", ["mine.py:1", "SyntaxError"]),
        ("import no_such_module\n", ["mine.py:1", "no_such_module"]),
        (
            "from spadmnist import Effect\n\n\nclass Mine(Effect, stage='dark'):\n    pass\n",
            ["mine.py:4", "Mine", "apply"],
        ),
        (
            "from spadmnist import Effect\n\n\nclass DeadTime(Effect, stage='dark'):\n"
            "    def apply(self, rate, conditions):\n        return rate\n",
            ["mine.py", "dead_time", "already there"],
        ),
    ],
)
@pytest.mark.parametrize("verb", ["generate", "effects"])
def test_a_plug_in_that_cannot_be_loaded(
    verb: str, text: str, words: list[str], made: tuple[Path, Path], tmp_path: Path
) -> None:
    (tmp_path / "mine.py").write_text(text)
    arguments = [made[0], "-o", "out"] if verb == "generate" else []
    result = run(verb, *arguments, "--plugin", "mine.py", cwd=tmp_path)
    assert_sentence(result, *words)
    assert len(result.stderr.splitlines()) == 1 and result.stdout == "", result
    assert sorted(tree(tmp_path)) == ["mine.py"]


@pytest.mark.slow
def test_positions_that_cannot_be(made: tuple[Path, Path], tmp_path: Path) -> None:
    text = made[0].read_text().replace("layout: {rows: 8, columns: 8,", "layout: {positions: places.csv,")
    assert "places.csv" in text
    (tmp_path / "c.yaml").write_text(text)
    for places, words in (
        (None, ["no such file"]),
        ("x,y\n0,0\n5,0\n0,0\n", ["places.csv:4", "line 2"]),
        ("x,y\n0,0\n5,0\n", ["1 x 2", "8 x 8"]),
    ):
        if places:
            (tmp_path / "places.csv").write_text(places)
        result = run("generate", "c.yaml", "-o", "out", cwd=tmp_path)
        assert_sentence(result, *words)
        assert len(result.stderr.splitlines()) == 1 and not (tmp_path / "out").exists()


def test_every_mistake_of_a_config_on_a_line_of_its_own(made: tuple[Path, Path], tmp_path: Path) -> None:
    text = made[0].read_text()
    for old, new in (
        ("seed: 3", "seed: three"),
        ("exposure: 1 ms", "exposure: 1"),
        ("rate: 100 Hz", "rate: 100 ns"),
        ("dead_time: {duration", "dead_tme: {duration"),
        ("[counts,", "[countz,"),
        ("rows: 8, columns: 8, pixel_area", "rows: 8, colums: 8, pixel_area"),
    ):
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "bad.yaml").write_text(text)
    result = run("generate", tmp_path / "bad.yaml", "-o", tmp_path / "out")
    assert_sentence(result, "dead_tme", "Did you mean dead_time", "100 ns", "colums")
    lines = result.stderr.splitlines()
    assert len(lines) >= 5 and all(line.startswith("Error: ") and "bad.yaml:" in line for line in lines), lines
    assert sorted(tree(tmp_path)) == ["bad.yaml"]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("lux: [5 mlux, 2560 mlux]", "lux: [1e20 lux]"),
        ("lux: [5 mlux, 2560 mlux]", "lux: [5 mlux, 1e12 lux]"),
        ("rate: 100 Hz", "rate: 1e18 Hz"),
        ("seed: 3", f"seed: {'9' * 5000}"),
        ("frames: 100, frame_time: 10.0 us", "frames: 1000000000, frame_time: 1 ps"),
        ("train: 20", "train: 1000000000"),
        ("lux: [5 mlux, 2560 mlux]", "lux: [.nan lux]"),
        ("lux: [5 mlux, 2560 mlux]", "lux: [0 lux]"),
        ("exposure: 1 ms", "exposure: -1 ms"),
    ],
)
@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
def test_absurd_values_are_refused_at_once(
    old: str, new: str, dry: list[str], made: tuple[Path, Path], tmp_path: Path
) -> None:
    """1e15 photons a pixel, among others: before anything is written, without much memory."""
    text = made[0].read_text()
    assert old in text
    (tmp_path / "c.yaml").write_text(text.replace(old, new))
    started = time.monotonic()
    result = run("generate", tmp_path / "c.yaml", "-o", tmp_path / "out", *dry)
    assert_sentence(result)
    assert time.monotonic() - started < 10
    assert sorted(tree(tmp_path)) == ["c.yaml"]


SPELLINGS = [".5 lux", "5 ulux", *(pytest.param(x, marks=pytest.mark.slow) for x in ("+5 mlux", "5. mlux", "5e-3 lux"))]


@pytest.mark.parametrize("level", SPELLINGS)
def test_levels_in_any_spelling(level: str, tmp_path: Path) -> None:
    """Made and found again by the name that the config gives, or refused with a sentence."""
    file = write_config(tmp_path / "c.yaml", levels=(level,), train=3, test=1)
    result = run("generate", file, "-o", tmp_path / "out", "--jobs", 1)
    if result.returncode:
        assert_sentence(result, level)
    else:
        assert level in result.stdout
        assert run("verify", tmp_path / "out").returncode == 0


@pytest.mark.slow
def test_a_vast_number_of_images_is_planned_at_once(made: tuple[Path, Path], tmp_path: Path) -> None:
    """All of them are the same: none need be looked at twice."""
    text = (
        made[0]
        .read_text()
        .replace(
            "{source: digits, train: 20, test: 6, rows: 8, columns: 8}", "{source: uniform, repetitions: 2000000000}"
        )
    )
    assert "uniform" in text
    (tmp_path / "c.yaml").write_text(text)
    for options in (["--dry-run"], []):
        refused = run("generate", tmp_path / "c.yaml", "-o", tmp_path / "out", *options, timeout=20)
        assert_sentence(refused, "at most 1000000")
    (tmp_path / "c.yaml").write_text(text.replace("2000000000", "1000000"))
    dry = run("generate", tmp_path / "c.yaml", "-o", tmp_path / "out", "--dry-run", timeout=20)
    assert dry.returncode == 0, dry.stderr


# --- places -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_places_that_are_taken(made: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.tex").write_text("mine")
    (tmp_path / "broken").symlink_to("nowhere")
    before = tree(tmp_path)
    for place in ("file", "foreign", "file/below", "broken", "x" * 300):
        result = run("generate", made[0], "-o", tmp_path / place)
        assert_sentence(result, place)
        assert len(result.stderr.splitlines()) == 1, result.stderr
        assert_same(tmp_path, before)


def _mounted(options: str, place: Path) -> Iterator[Path]:
    place.mkdir()
    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("mounting needs root")
    if subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", place], capture_output=True).returncode:
        pytest.skip("mounting is not allowed here")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", place], check=True)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of its own."""
    yield from _mounted("size=64m", tmp_path / "disk")


def remount(disk: Path, options: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{options}", disk], check=True)


def test_a_place_that_cannot_be_written(made: tuple[Path, Path], tmp_path: Path) -> None:
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere; the read-only disk stands for it")
    (tmp_path / "closed").mkdir()
    (tmp_path / "closed").chmod(stat.S_IRUSR | stat.S_IXUSR)
    assert_sentence(run("generate", made[0], "-o", tmp_path / "closed" / "out"), "closed", "-o")


@pytest.mark.slow
def test_a_read_only_disk(made: tuple[Path, Path], disk: Path) -> None:
    shutil.copytree(made[1], disk / "out")
    shutil.copy(made[0], disk / "c.yaml")
    shutil.copytree(made[1], disk / "hurt")
    next((disk / "hurt").rglob("images/train/*.zip")).write_bytes(b"")
    remount(disk, "ro")
    before = tree(disk)
    for arguments in (
        ["generate", disk / "c.yaml", "-o", disk / "new"],
        ["generate", disk / "c.yaml", "-o", disk / "new" / "deeper"],
        ["verify", disk / "hurt", "--repair"],
        ["inspect", disk / "out", "--plot", disk / "x.png"],
    ):
        result = run(*arguments)
        assert_sentence(result, str(disk), "read-only" if arguments[0] == "generate" else "ead-only")
        assert len(result.stderr.splitlines()) == 1, result.stderr
    # what only reads, works
    assert run("verify", disk / "out").returncode == 0
    assert run("inspect", disk / "out").returncode == 0
    assert run("generate", disk / "c.yaml", "-o", disk / "out").returncode == 0
    assert_same(disk, before)


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_full_disk(jobs: int, made: tuple[Path, Path], disk: Path) -> None:
    need = sum(-(-p.stat().st_size // 4096) * 4096 for p in made[1].rglob("*") if p.is_file())
    remount(disk, f"size={int(need * 0.7)}")
    result = run("generate", made[0], "-o", disk / "out", "--jobs", jobs)
    assert_sentence(result, str(disk), "space")
    assert len(result.stderr.splitlines()) == 1, result.stderr
    there = tree(disk / "out").items()
    kept = {n: c for n, c in there if not n.startswith(".spadmnist") and c != "empty folder"}
    assert kept, "nothing was made before the disk was full"
    complete = tree(made[1])
    assert all(complete.get(n) == c for n, c in kept.items()), "something incomplete is in place"
    remount(disk, "size=64m")
    again = run("generate", made[0], "-o", disk / "out", "--jobs", jobs)
    assert again.returncode == 0, again.stderr
    assert "were there already" in again.stderr or "was there already" in again.stderr
    assert_same(disk / "out", complete)


@pytest.mark.slow
def test_a_disk_that_fills_during_reconstruct(made: tuple[Path, Path], disk: Path) -> None:
    few = write_config(disk / "few.yaml", levels=("5 mlux", "2560 mlux"), methods=("counts",), train=20, test=6)
    make(few, disk / "out")
    used = sum(-(-p.stat().st_size // 4096) * 4096 for p in disk.rglob("*") if p.is_file())
    remount(disk, f"size={used + 60_000}")
    result = run("reconstruct", disk / "out", "--jobs", 1)
    assert_sentence(result, "space")
    remount(disk, "size=64m")
    assert run("inspect", disk / "out").returncode == 0
    assert run("reconstruct", disk / "out", "--jobs", 1).returncode == 0
    assert run("verify", disk / "out").returncode == 0
    assert len(json.loads((disk / "out" / "manifest.json").read_text())["config"]["reconstruct"]) == 6


# --- names --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_names_with_blanks_and_of_any_alphabet(made: tuple[Path, Path], tmp_path: Path) -> None:
    """Relative, with a plug-in, for every verb."""
    home = tmp_path / "Größe mit Leer 数"
    home.mkdir()
    (home / "my effect.py").write_text(
        'from spadmnist import Effect\n\n\nclass Dimmer(Effect, stage="light"):\n    """Halves the light."""\n\n'
        "    def apply(self, rate, conditions):\n        return rate / 2\n"
    )
    write_config(home / "a b.yaml", levels=("2560 mlux",), train=4, test=2, more="    dimmer: {}\n")
    plugin = ("--plugin", "my effect.py", "--jobs", 1)
    result = run("generate", "a b.yaml", *plugin, cwd=home)
    assert result.returncode == 0, result.stderr
    assert run("verify", "a b", cwd=home).returncode == 0
    assert run("inspect", "a b", "--plot", "ü b.png", cwd=home).returncode in (0, 2)
    expected = tree(home / "a b")
    next((home / "a b").rglob("2560_mlux/train/*.zip")).write_bytes(b"x")
    assert_sentence(run("verify", "a b", "--repair", cwd=home), "dimmer")
    repaired = run("verify", "a b", "--repair", *plugin, cwd=home)
    assert repaired.returncode == 0, repaired
    assert_same(home / "a b", expected)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_end_in_the_middle_of_compiled_code_is_no_fault(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], number: int, code: int
) -> None:
    """Compiled code turns what a signal raises into a SystemError."""
    from spadmnist import interrupts

    def stopped(*given: object, **more: object) -> None:
        monkeypatch.setattr(interrupts, "_came", [(number, 0.0)])
        raise SystemError("returned a result with an exception set")

    monkeypatch.setattr(command_line.cli, "main", stopped)
    assert command_line._run([]) == code
    said = capfd.readouterr().err
    assert "fault" not in said and ("Interrupted" in said) == (number == signal.SIGINT)


def test_no_warning_of_a_library_reaches_a_user(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Not where it is raised in the verb; a programmer sees it with SPADMNIST_DEBUG, or with -W."""
    import warnings

    def warned(*given: object, **more: object) -> None:
        warnings.warn("A worker stopped while some jobs were given to the executor.", UserWarning, stacklevel=1)
        warnings.warn("divide by zero encountered in divide", RuntimeWarning, stacklevel=1)

    monkeypatch.setattr(command_line.cli, "main", warned)
    monkeypatch.setattr(command_line.interrupts, "install", lambda: None)
    monkeypatch.setattr(sys, "warnoptions", [])
    for debugging, says in (("", False), ("1", True)):
        monkeypatch.setenv("SPADMNIST_DEBUG", debugging)
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            warnings.showwarning = lambda message, *_: print(message, file=sys.stderr)
            with pytest.raises(SystemExit) as caught:
                command_line.main([])
        assert caught.value.code == 0
        assert ("divide by zero" in capfd.readouterr().err) == says


def test_a_log_has_a_line_now_and_then(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Where standard error is no terminal, what takes longer than 10 s says every 30 s how far it is.

    The first work, which compiles, says nothing of the rest.
    """
    from spadmnist.cli import _terminal

    now = 0.0
    monkeypatch.setattr(_terminal.time, "monotonic", lambda: now)
    with _terminal.progress() as progress:
        progress.start("comparing", 100.0, 0.0)
        for now in (4.0, 9.0, 12.0, 41.0, 43.0, 99.0, 100.0):
            progress.advance(1.0 if now < 99 else 47.5, "lit")
    assert capsys.readouterr().err.splitlines() == [
        "comparing 3%, 12.0 s, 6.5 min left",
        "comparing 5%, 43.0 s, 15.4 min left",
        "comparing 52%, 99.0 s, 87.6 s left",
    ]


def test_a_log_says_soon_what_it_did_not_know(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from spadmnist.cli import _terminal

    now = 0.0
    monkeypatch.setattr(_terminal.time, "monotonic", lambda: now)
    with _terminal.progress() as progress:
        progress.start("comparing", 100.0, 0.0)
        for moment in (58.0, 60.0, 68.0, 70.0, 97.0):
            now = moment
            progress.advance(2.0, "lit")
    assert capsys.readouterr().err.splitlines() == [
        "comparing 2%, 58.0 s, estimating",
        "comparing 6%, 68.0 s, 3.9 min left",
    ]


@pytest.mark.parametrize("stream", [None, SimpleNamespace(write=len, flush=lambda: None), "closed"])
def test_what_stands_in_place_of_standard_error_is_no_terminal(stream: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from spadmnist.cli import _terminal

    if stream == "closed":
        stream = io.StringIO()
        stream.close()
    monkeypatch.setattr(sys, "stderr", stream)
    with _terminal.progress() as progress:
        progress.start("comparing", 0.0, 0.0)
        progress.advance(1.0, "lit")


def test_time_left_is_not_shown_before_it_is_known() -> None:
    """A slow first part of the work (workers that start) is no estimate of the rest. The clock is given."""
    from spadmnist.cli._terminal import time_left

    assert time_left(0.0, 100.0, 50.0) == "estimating"
    assert time_left(1.0, 99.0, 20.0) == "estimating"  # would be 33 min
    assert time_left(50.0, 50.0, 1.0) == "estimating"
    assert time_left(2.0, 98.0, 2.0) == "98.0 s left"
    assert time_left(1.0, 99.0, 30.0) == "49.5 min left"
    assert time_left(100.0, 0.0, 40.0) == "0.0 s left"
